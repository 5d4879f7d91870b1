//! A server whose disk is full, or can only be read: what is served is served on, and a change that
//! cannot be written is refused with a clear error and leaves no revision behind.

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::kills::{Running, address_of, import, words};
use crate::program::{refuses, seese3, succeeds, text};

/// The size of the disk of the store, bytes: for a few revisions.
const DISK: usize = 2 << 20;
/// So many revisions do not fit on it.
const TOO_MANY: u32 = 40;

/// A program in a mount namespace of its own, such that it may mount file systems.
fn apart(script: &str) -> Command {
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--mount", "sh", "-c", script]);
    command
}

/// A server with a small disk of its own, onto which the store at `source` is copied first.
struct Apart {
    server: Running,
    address: String,
    /// Where its disk is, as it sees it.
    store: String,
}

impl Apart {
    fn start(source: &str, folder: &Path) -> Self {
        let disk = folder.join("disk");
        std::fs::create_dir(&disk).unwrap();
        let store = text(&disk).to_owned();

        let script = format!(
            "mount -t tmpfs -o size={DISK} none '{store}' && cp -r '{source}/.' '{store}' && \
             exec '{}' serve --store '{store}' --listen 127.0.0.1:0 --writable",
            env!("CARGO_BIN_EXE_seese3")
        );
        let log = File::create(folder.join("log")).unwrap();
        let child = apart(&script)
            .env_remove("SEESE3_STORE")
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();

        let mut server = Running(child);
        let address = address_of(&mut server);
        Self {
            server,
            address,
            store,
        }
    }

    /// Runs a program where the server's disk is.
    fn run(&self, program: &[&str]) {
        let id = self.server.0.id().to_string();
        let entered = Command::new("nsenter")
            .args(["--user", "--mount", "--preserve-credentials", "--target"])
            .arg(id)
            .args(program)
            .output()
            .unwrap();
        let error = String::from_utf8_lossy(&entered.stderr);
        assert!(entered.status.success(), "{program:?}: {error}");
    }

    /// Runs our program where the server's disk is.
    fn seese3(&self, arguments: &[&str]) {
        let program = [env!("CARGO_BIN_EXE_seese3")];
        self.run(&[&program, arguments, &["--store", &self.store]].concat());
    }

    /// The arguments that send room `a` of the store at `source` to it.
    fn push<'a>(&'a self, source: &'a str) -> [&'a str; 6] {
        [
            "push",
            "rooms/a",
            "--store",
            source,
            "--server",
            &self.address,
        ]
    }

    /// It answers a question about room `a`.
    fn answers(&self) {
        let server = &self.address;
        let question = ["navigate", "--room", "a", "--from", "1", "--to", "9"];
        succeeds(&[&question[..], &["--server", server]].concat());
    }
}

/// Waits until the server's log, which is written beside its answers, says this.
fn until_logged(folder: &Path, words: &str) {
    let log = || std::fs::read_to_string(folder.join("log")).unwrap();
    for _ in 0..600 {
        if log().contains(words) {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("{words} is not in the log: {}", log());
}

/// Oracle: the promise: clear errors, serving goes on, and what makes room lets changes through.
#[test]
fn a_full_and_a_read_only_disk_stop_changes_and_nothing_else() {
    if !apart("mount -t tmpfs none /mnt")
        .status()
        .is_ok_and(|mount| mount.success())
    {
        // The macros that print are silent in a test that passes.
        let said = "SKIPPED a full and a read-only disk: no program may mount one of its own here";
        writeln!(std::io::stderr(), "{said}").unwrap();
        return;
    }

    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("source");
    let source = text(&source);
    succeeds(&words(&import(folder.path(), 0, source)));
    let train = [
        "train",
        "--room",
        "a",
        "--preset",
        "paper-base",
        "--epochs",
        "1",
    ];
    seese3(&[&train[..], &["--store", source]].concat());

    let server = Apart::start(source, folder.path());
    server.answers();

    // Until the disk is full.
    let fits = |version: &u32| {
        succeeds(&words(&import(folder.path(), *version, source)));
        seese3(&server.push(source)).status.success()
    };
    let taken = (1..TOO_MANY).take_while(fits).count();
    assert!((1..TOO_MANY as usize - 1).contains(&taken), "{taken}");

    refuses(
        &server.push(source),
        &["the store cannot be read or written"],
    );
    until_logged(folder.path(), "No space left on device");
    server.answers();
    server.seese3(&["store", "verify"]);

    // What is removed makes room.
    server.seese3(&["store", "rm", "rooms/a/revisions/1"]);
    server.seese3(&["store", "gc", "--older-than", "0"]);
    succeeds(&server.push(source));

    let remount =
        |how: &str| server.run(&["mount", "-o", &format!("remount,{how}"), &server.store]);
    remount("ro");
    succeeds(&words(&import(folder.path(), TOO_MANY, source)));
    refuses(
        &server.push(source),
        &["the store cannot be read or written"],
    );
    until_logged(folder.path(), "Read-only file system");
    server.answers();

    remount("rw");
    server.seese3(&["store", "rm", "rooms/a/revisions/2"]);
    server.seese3(&["store", "gc", "--older-than", "0"]);
    succeeds(&server.push(source));
    server.seese3(&["store", "verify"]);
}
