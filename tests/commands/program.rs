//! The program as a test runs it.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// A new folder in which the program runs. Its entry `golden` is the folder of committed oracles.
pub struct Place(tempfile::TempDir);

impl Place {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink(seese3_testing::golden(), folder.path().join("golden")).unwrap();
        Self(folder)
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn json(&self, name: &str) -> serde_json::Value {
        seese3_testing::json(&self.file(name))
    }

    /// The program with these arguments, separated by spaces, and with no setting of the caller's
    /// environment.
    pub fn program(&self, arguments: &str) -> Command {
        let mut program = Command::new(env!("CARGO_BIN_EXE_seese3"));
        program
            .args(arguments.split_whitespace())
            .current_dir(self.0.path())
            .env_remove("SEESE3_STORE")
            .env_remove("SEESE3_RUNTIME")
            .env_remove("SEESE3_DEVICE");
        program
    }

    /// The arguments that publish an oracle's room under another name.
    pub fn import(room: &str, golden_room: &str) -> String {
        let folder = format!("golden/rooms/{golden_room}");
        let features = format!("fourier={folder}/features.npy");
        let poses = format!("{folder}/poses.npy");
        format!("import numpy --name {room} --poses {poses} --features {features} --store store")
    }

    /// What the program does. The JSON of a successful command has to be as documented.
    #[track_caller]
    pub fn run(&self, arguments: &str) -> Output {
        let output = self.program(arguments).output().unwrap();
        let words: Vec<&str> = arguments.split_whitespace().collect();
        let json = words.iter().position(|&word| word == "--json");
        if let Some(place) = json
            && output.status.success()
            && words[0] != "track"
        {
            let written = match words.get(place + 1) {
                Some(file) if !file.starts_with('-') => self.json(file),
                _ => serde_json::from_slice(&output.stdout).unwrap(),
            };
            crate::schemas::check(arguments, &written);
        }
        output
    }

    /// Starts the program without waiting for it.
    pub fn start(&self, arguments: &str) -> Running {
        Running::start(self.program(arguments).stderr(Stdio::null()))
    }

    /// A server with these options that serves the store.
    pub fn serve(&self, options: &str) -> Running {
        let serve = "serve --store store --listen 127.0.0.1:0";
        let mut server = self.start(&format!("{serve} {options}"));
        self.until_served(&mut server);
        server
    }

    /// Waits until a server that has just been started serves.
    pub fn until_served(&self, server: &mut Running) {
        let mut line = String::new();
        let stdout = server.process.stdout.take().unwrap();
        BufReader::new(stdout).read_line(&mut line).unwrap();
        let address = line.trim().strip_prefix("listening on ");
        server.address = address.unwrap().to_owned();

        let health = format!("health --server {}", server.address);
        until("the server serves", || self.run(&health).status.success());
    }

    /// What the program prints; it has to succeed, without errors or warnings in a pipe.
    #[track_caller]
    pub fn succeeds(&self, arguments: &str) -> String {
        let output = self.run(arguments);
        let error = said(&output);
        assert!(output.status.success(), "{arguments}: {error}");
        assert_eq!(error, "", "nothing on standard error in a pipe");

        String::from_utf8(output.stdout).unwrap()
    }

    /// The program has to succeed and to print all these words.
    #[track_caller]
    pub fn prints(&self, arguments: &str, words: &[&str]) -> String {
        let printed = self.succeeds(arguments);
        for word in words {
            assert!(
                printed.contains(word),
                "{arguments}: {printed} does not say {word}"
            );
        }
        printed
    }

    /// The program has to refuse each of these further arguments with words of its own.
    #[track_caller]
    pub fn refuses_each(&self, arguments: &str, cases: &[(&str, &[&str])]) {
        for (more, words) in cases {
            self.refuses(&format!("{arguments} {more}"), words);
        }
    }

    /// The program has to fail with one line on standard error that contains every word.
    #[track_caller]
    pub fn refuses(&self, arguments: &str, words: &[&str]) {
        let output = self.run(arguments);
        let error = said(&output);
        assert!(!output.status.success(), "{arguments}");
        assert!(
            error.starts_with("error: ") && error.trim_end().lines().count() == 1,
            "{arguments}: {error}"
        );

        for word in words {
            assert!(
                error.contains(word),
                "{arguments}: {error} does not say {word}"
            );
        }
    }
}

/// A program that runs. It is killed at the end of the test, if not before.
pub struct Running {
    pub process: Child,
    /// Where a server listens.
    pub address: String,
}

impl Running {
    pub fn start(program: &mut Command) -> Self {
        Self {
            process: program.stdout(Stdio::piped()).spawn().unwrap(),
            address: String::new(),
        }
    }

    pub fn kill(&mut self) {
        // An error means that it has ended.
        let _ = self.process.kill();
        self.process.wait().unwrap();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.kill();
    }
}

/// What the program wrote to standard error, without the lines of progress that come after 30 s:
/// on a slow machine any command prints some.
pub fn said(output: &Output) -> String {
    let error = String::from_utf8(output.stderr.clone()).unwrap();
    let mut lines = error.lines().filter(|line| !is_progress(line)).peekable();
    let end = if lines.peek().is_some() { "\n" } else { "" };
    lines.collect::<Vec<_>>().join("\n") + end
}

/// Whether a line is "WHAT: N of M after S s, ...", "WHAT: N of M after S s" or "WHAT: N after S s ...".
fn is_progress(line: &str) -> bool {
    let is_number = |word: &str| word.parse::<u64>().is_ok();
    let Some((_, counted)) = line.split_once(": ") else {
        return false;
    };

    match counted.split(' ').collect::<Vec<_>>()[..] {
        [count, "of", length, "after", seconds, "s," | "s", ..] => {
            [count, length, seconds].into_iter().all(is_number)
        }
        [count, "after", seconds, "s", ..] => is_number(count) && is_number(seconds),
        _ => false,
    }
}

/// Oracle: lines of progress as the program prints them, and an error and a warning.
#[test]
fn lines_of_progress_are_no_errors() {
    assert!(is_progress(
        "training: 3 of 250 after 30 s, about 9 s left loss 0.1"
    ));
    assert!(is_progress("training the reader: 0 of 1 after 30 s"));
    assert!(is_progress("reading: 31 after 60 s"));
    assert!(!is_progress("error: 3 of 250 frames after 30 s are lost"));
    assert!(!is_progress("warning: 3 frames come after 30 s"));
}

/// Waits until something is so, for at most a minute.
#[track_caller]
pub fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let began = Instant::now();
    while !is_so() {
        assert!(
            began.elapsed() < Duration::from_secs(60),
            "never happened: {what}"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
}
