//! A SeaweedFS server with an S3 endpoint, in a process of its own.

use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use object_store::aws::AmazonS3Builder;
use object_store::{ClientOptions, ObjectStore, ObjectStoreExt, PutPayload, RetryConfig};
use seese3_store::Store;

const KEY: &str = "key";
const SECRET: &str = "secret";
const BUCKET: &str = "rooms";
/// Time limit for its start.
const START: Duration = Duration::from_secs(60);

/// A running server; killed when dropped.
pub struct Seaweed {
    program: PathBuf,
    folder: tempfile::TempDir,
    ports: [u16; 4],
    process: Child,
}

impl Seaweed {
    /// Starts the program that `SEESE3_WEED` names, on free ports.
    pub async fn start() -> Self {
        let program =
            std::env::var_os("SEESE3_WEED").expect("SEESE3_WEED names the program `weed`");
        let folder = tempfile::tempdir().unwrap();
        let identities = serde_json::json!({"identities": [{
            "name": "test",
            "credentials": [{"accessKey": KEY, "secretKey": SECRET}],
            "actions": ["Admin", "Read", "Write", "List"],
        }]});
        std::fs::write(folder.path().join("s3.json"), identities.to_string()).unwrap();
        let program = PathBuf::from(program);
        let ports = free_ports();
        let mut seaweed = Self {
            process: run(&program, folder.path(), ports),
            program,
            folder,
            ports,
        };
        seaweed.is_ready().await;
        seaweed
    }

    /// Ends the process at once, as a power failure would.
    pub fn kill(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }

    /// Starts it again, with its data.
    pub async fn restart(&mut self) {
        self.process = run(&self.program, self.folder.path(), self.ports);
        self.is_ready().await;
    }

    /// The bucket.
    pub fn objects(&self) -> Arc<dyn ObjectStore> {
        Arc::new(self.builder().build().unwrap())
    }

    /// A store of the program's own in a folder of the bucket, with its settings of retries.
    pub fn store(&self, prefix: &str) -> Store {
        let (url, variables) = self.settings(prefix);
        Store::open_with(&url, &variables).unwrap()
    }

    /// The URL of a folder of the bucket, and the variables of the environment that open it.
    pub fn settings(&self, prefix: &str) -> (String, Vec<(String, String)>) {
        let endpoint = format!("http://127.0.0.1:{}", self.ports[3]);
        let variables = [
            ("AWS_ENDPOINT", endpoint.as_str()),
            ("AWS_ACCESS_KEY_ID", KEY),
            ("AWS_SECRET_ACCESS_KEY", SECRET),
            ("AWS_ALLOW_HTTP", "true"),
        ]
        .map(|(name, value)| (name.to_owned(), value.to_owned()));
        (format!("s3://{BUCKET}/{prefix}"), variables.to_vec())
    }

    fn builder(&self) -> AmazonS3Builder {
        AmazonS3Builder::new()
            .with_endpoint(format!("http://127.0.0.1:{}", self.ports[3]))
            .with_access_key_id(KEY)
            .with_secret_access_key(SECRET)
            .with_bucket_name(BUCKET)
            .with_allow_http(true)
    }

    /// Waits until the bucket is there and can be written.
    async fn is_ready(&mut self) {
        let began = Instant::now();
        loop {
            let path = object_store::path::Path::from("ready");
            let client = ClientOptions::new()
                .with_timeout(Duration::from_secs(2))
                .with_allow_http(true);
            let retry = RetryConfig {
                max_retries: 0,
                ..RetryConfig::default()
            };
            let objects = self
                .builder()
                .with_client_options(client)
                .with_retry(retry)
                .build()
                .unwrap();
            match objects.put(&path, PutPayload::new()).await {
                Ok(_) => return,
                Err(error) => assert!(began.elapsed() < START, "{error}"),
            }
            if let Some(ended) = self.process.try_wait().unwrap() {
                let log = std::fs::read_to_string(self.folder.path().join("log")).unwrap();
                panic!("weed has ended, {ended}: {log}");
            }
            self.make_bucket().await;
        }
    }

    /// Makes the bucket, once the server has started.
    async fn make_bucket(&self) {
        let mut shell = Command::new(&self.program)
            .args(["shell", &format!("-master=127.0.0.1:{}", self.ports[0])])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let command = format!("s3.bucket.create -name {BUCKET}\nexit\n");
        let mut input = shell.stdin.take().unwrap();
        input.write_all(command.as_bytes()).unwrap();
        drop(input);

        // It waits for a server that does not answer.
        for _ in 0..20 {
            if shell.try_wait().unwrap().is_some() {
                return;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        shell.kill().unwrap();
        shell.wait().unwrap();
    }
}

fn run(program: &Path, folder: &Path, [master, volume, filer, s3]: [u16; 4]) -> Child {
    let data = folder.join("data");
    std::fs::create_dir_all(&data).unwrap();
    let log = std::fs::File::create(folder.join("log")).unwrap();
    Command::new(program)
        .arg("-logtostderr=true")
        .args([
            "server",
            "-ip=127.0.0.1",
            "-ip.bind=127.0.0.1",
            "-s3",
            "-filer=true",
        ])
        .args([
            "-master.telemetry=false",
            "-master.volumeSizeLimitMB=64",
            "-volume.max=20",
        ])
        .arg(format!("-dir={}", data.display()))
        .arg(format!("-s3.config={}", folder.join("s3.json").display()))
        .args([
            format!("-master.port={master}"),
            format!("-volume.port={volume}"),
        ])
        .args([format!("-filer.port={filer}"), format!("-s3.port={s3}")])
        .args(["-s3.port.iceberg=0", "-s3.port.lance=0"])
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap()
}

/// Ports that are free now, below those that the system gives away. Each server also listens at its
/// port + 10,000.
fn free_ports() -> [u16; 4] {
    let mut ports = (11_000..20_000).filter(|port| {
        let is_free = |port: u16| TcpListener::bind(("127.0.0.1", port)).is_ok();
        is_free(*port) && is_free(port + 10_000)
    });
    std::array::from_fn(|_| ports.next().expect("a free port"))
}

impl Drop for Seaweed {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}
