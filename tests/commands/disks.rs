//! A server whose disk is full, or can only be read: what is served is served on, and a change that
//! cannot be written is refused with a clear error and leaves no revision behind.

use std::fs::File;
use std::io::Write;
use std::process::Command;

use crate::kills::import;
use crate::program::{Place, Running, until};

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

/// A server with a small disk of its own, onto which the store `source` is copied first.
struct Apart<'a> {
    here: &'a Place,
    server: Running,
    /// Where its disk is, as it sees it.
    store: String,
}

impl<'a> Apart<'a> {
    fn start(here: &'a Place) -> Self {
        let [disk, source] = ["disk", "source"].map(|name| here.file(name));
        std::fs::create_dir(&disk).unwrap();
        let [store, source] = [disk, source].map(|path| path.to_str().unwrap().to_owned());

        let script = format!(
            "mount -t tmpfs -o size={DISK} none '{store}' && cp -r '{source}/.' '{store}' && \
             exec '{}' serve --store '{store}' --listen 127.0.0.1:0 --writable",
            env!("CARGO_BIN_EXE_seese3")
        );
        let log = File::create(here.file("log")).unwrap();
        let mut program = apart(&script);
        let mut server = Running::start(program.env_remove("SEESE3_STORE").stderr(log));
        here.until_served(&mut server);
        Self {
            here,
            server,
            store,
        }
    }

    /// Runs a program where the server's disk is.
    fn run(&self, program: &[&str]) {
        let id = self.server.process.id().to_string();
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
    fn seese3(&self, arguments: &str) {
        let program = [env!("CARGO_BIN_EXE_seese3")];
        let arguments: Vec<&str> = arguments.split(' ').collect();
        self.run(&[&program, &arguments[..], &["--store", &self.store]].concat());
    }

    /// The arguments that send room `a` of the store `source` to it.
    fn push(&self) -> String {
        format!(
            "push rooms/a --replace --store source --server {}",
            self.server.address
        )
    }

    /// It answers a question about room `a`.
    fn answers(&self) {
        let question = "navigate --room a --from 1 --to 9";
        let address = &self.server.address;
        self.here
            .succeeds(&format!("{question} --server {address}"));
    }

    /// A change is refused with a clear error, of which the log, which is written beside the
    /// answers, says the cause.
    fn refuses_changes(&self, cause: &str) {
        let words = ["the store cannot be read or written"];
        self.here.refuses(&self.push(), &words);

        let log = || std::fs::read_to_string(self.here.file("log")).unwrap();
        until(cause, || log().contains(cause));
        self.answers();
    }

    /// What is removed makes room.
    fn makes_room(&self, revision: &str) {
        self.seese3(&format!("store rm rooms/a/revisions/{revision}"));
        self.seese3("store gc --older-than 0 --no-concurrent-publishers");
        self.here.succeeds(&self.push());
    }
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

    let here = Place::new();
    let publish = |version| here.succeeds(&import(&here, version, "source"));
    publish(0);
    here.run("train --room a --preset paper-base --epochs 1 --store source");

    let server = Apart::start(&here);
    server.answers();

    // Until the disk is full.
    let fits = |version: &u32| {
        publish(*version);
        here.run(&server.push()).status.success()
    };
    let taken = (1..TOO_MANY).take_while(fits).count();
    assert!((1..TOO_MANY as usize - 1).contains(&taken), "{taken}");

    server.refuses_changes("No space left on device");
    server.seese3("store verify");
    server.makes_room("1");

    let remount =
        |how: &str| server.run(&["mount", "-o", &format!("remount,{how}"), &server.store]);
    remount("ro");
    publish(TOO_MANY);
    server.refuses_changes("Read-only file system");

    remount("rw");
    server.makes_room("2");
    server.seese3("store verify");
}
