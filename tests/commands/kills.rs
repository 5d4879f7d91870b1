//! Publishers and servers that are killed at any moment: the store always opens at an old or at a
//! new revision, and is clean once its garbage is collected.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::program::{seese3, succeeds, text};
use seese3_testing::{features, golden};

/// How often each is killed: SEESE3_KILLS, 8 if it is not set; `just kills` asks for 200.
fn kills() -> u32 {
    let given = std::env::var("SEESE3_KILLS").ok();
    given.map_or(8, |count| count.parse().expect("SEESE3_KILLS is a number"))
}

/// A program that runs. It is killed at the end of the test, if not before.
pub struct Running(pub Child);

impl Running {
    fn kill(&mut self) {
        // An error means that it has ended.
        let _ = self.0.kill();
        self.0.wait().unwrap();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Starts the program without waiting for it.
fn started(arguments: &[&str]) -> Running {
    let child = Command::new(env!("CARGO_BIN_EXE_seese3"))
        .args(arguments)
        .env_remove("SEESE3_STORE")
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    Running(child)
}

/// Publishes room `a`; its features differ from those of every other `version`.
pub fn import(folder: &Path, version: u32, store: &str) -> [String; 6] {
    let file = folder.join(format!("features-{version}.npy"));
    let rows = features(&golden(), "synthetic") * (1.0 + version as f32);
    ndarray_npy::write_npy(&file, &rows).unwrap();

    let poses = golden().join("rooms/synthetic/poses.npy");
    [
        "import".to_owned(),
        "numpy".to_owned(),
        "--room=a".to_owned(),
        format!("--poses={}", text(&poses)),
        format!("--features=f={}", text(&file)),
        format!("--store={store}"),
    ]
}

pub fn words(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

/// The revision that the room has now, after `store verify` found nothing wrong.
fn intact_revision(store: &str) -> u64 {
    let said = succeeds(&["store", "verify", "--store", store]);
    assert!(said.contains("everything can be read"), "{said}");

    let shown = succeeds(&["store", "show", "rooms/a", "--json", "--store", store]);
    let shown: serde_json::Value = serde_json::from_str(&shown).unwrap();
    shown["current"].as_u64().unwrap()
}

/// The moments of kills: drawn from a time that grows when the work was cut short and shrinks when it
/// was finished, so that both happen however busy the machine is.
struct Moments {
    longest: Duration,
    random: ChaCha8Rng,
}

impl Moments {
    fn kill(&mut self, running: &mut Running) {
        let moment = self.longest.mul_f64(self.random.random_range(0.0..1.0));
        std::thread::sleep(moment);
        running.kill();
    }

    fn learn(&mut self, was_finished: bool) {
        self.longest = self.longest.mul_f64(if was_finished { 0.7 } else { 1.4 });
    }
}

/// Oracle: the promise of the store.
#[test]
fn a_publisher_that_is_killed_leaves_an_old_or_a_new_revision() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    let store = text(&store);

    let first = import(folder.path(), 0, store);
    let began = std::time::Instant::now();
    succeeds(&words(&first));
    let mut moments = Moments {
        longest: began.elapsed() * 2,
        random: ChaCha8Rng::seed_from_u64(1),
    };

    let mut before = intact_revision(store);
    let mut finished = 0;
    for version in 1..=kills() {
        let next = import(folder.path(), version, store);
        let mut child = started(&words(&next));
        moments.kill(&mut child);

        let now = intact_revision(store);
        assert!(now == before || now == before + 1, "{before} became {now}");
        finished += now - before;
        moments.learn(now > before);
        before = now;

        succeeds(&["store", "gc", "--older-than", "0", "--store", store]);
        assert_eq!(intact_revision(store), now);
    }

    // Some were killed in time and some were not: the moments were well chosen.
    assert!(finished > 0, "none was finished");
    assert!(finished < u64::from(kills()), "none was killed in time");
}

/// A server that takes changes, and its address.
fn serve(store: &str) -> (Running, String) {
    serve_with(store, &["--writable"])
}

/// A server with these options, and its address.
pub fn serve_with(store: &str, options: &[&str]) -> (Running, String) {
    let fixed = ["serve", "--store", store, "--listen", "127.0.0.1:0"];
    let mut server = started(&[&fixed, options].concat());
    let address = address_of(&mut server);
    (server, address)
}

/// The address of a server that has just been started, once it serves.
pub fn address_of(server: &mut Running) -> String {
    let mut line = String::new();
    BufReader::new(server.0.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    let address = line
        .trim()
        .strip_prefix("listening on ")
        .unwrap()
        .to_owned();

    for _ in 0..600 {
        if seese3(&["health", "--server", &address]).status.success() {
            return address;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("the server never served");
}

/// Oracle: the promise of uploads: all of one or nothing.
#[test]
fn a_server_that_is_killed_during_an_upload_leaves_an_old_or_a_new_revision() {
    let folder = tempfile::tempdir().unwrap();
    let (store, source) = (folder.path().join("store"), folder.path().join("source"));
    let (store, source) = (text(&store), text(&source));

    for place in [store, source] {
        succeeds(&words(&import(folder.path(), 0, place)));
    }

    // How long an upload takes that nobody kills.
    let (mut server, address) = serve(store);
    let began = std::time::Instant::now();
    succeeds(&["push", "rooms/a", "--store", source, "--server", &address]);
    let mut moments = Moments {
        longest: began.elapsed() * 2,
        random: ChaCha8Rng::seed_from_u64(2),
    };
    server.kill();

    let mut before = intact_revision(store);
    let mut finished = 0;
    for version in 1..=kills() {
        succeeds(&words(&import(folder.path(), version, source)));

        let (mut server, address) = serve(store);
        let mut push = started(&["push", "rooms/a", "--store", source, "--server", &address]);
        moments.kill(&mut server);
        push.0.wait().unwrap();

        let now = intact_revision(store);
        assert!(now == before || now == before + 1, "{before} became {now}");
        finished += now - before;
        moments.learn(now > before);
        before = now;

        succeeds(&["store", "gc", "--older-than", "0", "--store", store]);
        assert_eq!(intact_revision(store), now);
    }

    assert!(finished > 0, "none was finished");
    assert!(finished < u64::from(kills()), "none was killed in time");
}
