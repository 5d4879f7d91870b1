//! `made_by` of JSON results: what made them, so that a file can be made again.

use std::ffi::{OsStr, OsString};
use std::sync::OnceLock;
use std::time::Instant;

use chrono::{DateTime, SecondsFormat, Utc};
use clap::ArgMatches;
use clap::parser::ValueSource;
use serde::Serialize;

/// How the program was called. A static, because the command line belongs to the process.
static CALL: OnceLock<Call> = OnceLock::new();

/// The git commit of the program, with "-modified" for a changed tree; `None` if unknown.
pub const COMMIT: Option<&str> = option_env!("SEESE3_COMMIT");

/// The runtime of the encoder that was opened first.
static ENCODER_RUNTIME: OnceLock<String> = OnceLock::new();

#[derive(Debug)]
struct Call {
    command: String,
    seed: Option<u64>,
    time: DateTime<Utc>,
    begun: Instant,
}

/// What made a result.
#[derive(Debug, Clone, Serialize)]
pub struct MadeBy {
    /// The version of the program.
    version: &'static str,
    /// As [`COMMIT`].
    commit: Option<&'static str>,
    /// The command line, quoted for a POSIX shell.
    command: String,
    /// The value of --seed in effect; `None` for a command without that option.
    seed: Option<u64>,
    /// When the command began, RFC 3339 in UTC.
    time: String,
    machine: Machine,
    runtime: Runtime,
}

#[derive(Debug, Clone, Serialize)]
struct Machine {
    os: &'static str,
    arch: &'static str,
    /// The processor's model; `None` if the system does not state it.
    cpu: Option<String>,
    /// The number of cores that the program may use.
    cores: usize,
}

#[derive(Debug, Clone, Serialize)]
struct Runtime {
    /// From the start of the command to the result, seconds.
    seconds: f64,
    /// The runtime of the ONNX models, for example "tract" or "onnxruntime on cuda:0"; `None` if no
    /// model was opened.
    encoder: Option<String>,
}

/// Records the command line, for the results of this process.
pub fn remember_call(arguments: &[OsString], matches: &ArgMatches) {
    let call = Call {
        command: quoted(store_variable(matches).as_deref(), arguments),
        seed: seed(matches),
        time: Utc::now(),
        begun: Instant::now(),
    };
    // The command line is parsed once.
    let _ = CALL.set(call);
}

/// Records the runtime of an encoder, for the results of this process.
pub fn remember_encoder_runtime(runtime: &seese3_encoder::Runtime) {
    let _ = ENCODER_RUNTIME.set(runtime.to_string());
}

impl MadeBy {
    /// Of the running command, until now.
    pub fn now() -> Self {
        let call = CALL.get();
        let time = call.map_or_else(Utc::now, |call| call.time);
        let seconds = call.map_or(0.0, |call| call.begun.elapsed().as_secs_f64());

        Self {
            version: env!("CARGO_PKG_VERSION"),
            commit: COMMIT,
            command: call.map_or_else(String::new, |call| call.command.clone()),
            seed: call.and_then(|call| call.seed),
            time: time.to_rfc3339_opts(SecondsFormat::Secs, true),
            machine: Machine {
                os: std::env::consts::OS,
                arch: std::env::consts::ARCH,
                cpu: cpu_model(),
                cores: std::thread::available_parallelism().map_or(1, usize::from),
            },
            runtime: Runtime {
                seconds: (seconds * 1e3).round() / 1e3,
                encoder: ENCODER_RUNTIME.get().cloned(),
            },
        }
    }
}

/// The value of `--seed` in effect, of the innermost command.
fn seed(matches: &ArgMatches) -> Option<u64> {
    // An unknown name is an error, and means that the command has no such option.
    let mut values = innermost(matches).try_get_raw("seed").ok()??;
    values.next()?.to_str()?.parse().ok()
}

/// The store, if it is that of the variable SEESE3_STORE.
fn store_variable(matches: &ArgMatches) -> Option<OsString> {
    let matches = innermost(matches);
    let mut values = matches.try_get_raw("store").ok()??;
    let is_variable = matches.value_source("store") == Some(ValueSource::EnvVariable);
    values
        .next()
        .filter(|_| is_variable)
        .map(OsStr::to_os_string)
}

fn innermost(matches: &ArgMatches) -> &ArgMatches {
    let mut innermost = matches;
    while let Some((_, inner)) = innermost.subcommand() {
        innermost = inner;
    }
    innermost
}

/// The arguments as a line for a POSIX shell, after the variable of the store if it was used.
fn quoted(store: Option<&OsStr>, arguments: &[OsString]) -> String {
    let variable = store.map(|store| format!("SEESE3_STORE={}", quoted_word(store)));
    // The name of the program, whatever its folder.
    let words = variable.into_iter().chain(["seese3".to_owned()]);
    let options = arguments.iter().skip(1).map(|word| quoted_word(word));
    words.chain(options).collect::<Vec<_>>().join(" ")
}

/// A word for a POSIX shell. Bytes that are not UTF-8 are written as `$'\xFF'`, which bash, zsh and
/// ksh read.
fn quoted_word(word: &OsStr) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,@%+".contains(c);
    let Some(text) = word.to_str() else {
        let bytes = word.as_encoded_bytes().iter();
        let escaped = bytes.map(|&byte| match char::from(byte) {
            c if byte.is_ascii() && is_plain(c) => c.to_string(),
            _ => format!("\\x{byte:02x}"),
        });
        return format!("$'{}'", escaped.collect::<String>());
    };

    if !text.is_empty() && text.chars().all(is_plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

/// The processor's model, as Linux states it.
fn cpu_model() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the quoting rules of POSIX shells.
    #[test]
    fn command_lines_are_quoted_for_a_shell() {
        let arguments = ["/bin/x", "train", "--room", "studio*", "it's", ""].map(OsString::from);
        assert_eq!(
            quoted(None, &arguments),
            r"seese3 train --room 'studio*' 'it'\''s' ''"
        );
        let store = Some(OsStr::new("my store"));
        assert_eq!(
            quoted(store, &arguments[..2]),
            "SEESE3_STORE='my store' seese3 train"
        );
    }

    /// Oracle: bash: `printf %s $'room\xe9\x20b' | xxd -p` prints 726f6f6de92062.
    #[cfg(unix)]
    #[test]
    fn words_that_are_not_utf8_keep_their_bytes() {
        use std::os::unix::ffi::OsStrExt;
        let word = OsStr::from_bytes(b"room\xe9 b");
        assert_eq!(quoted_word(word), r"$'room\xe9\x20b'");
    }

    /// Oracle: clap: the default counts, and commands without a seed have none.
    #[test]
    fn the_seed_is_that_of_the_innermost_command() {
        let seed_option = clap::Arg::new("seed").long("seed").default_value("7");
        let command = || {
            clap::Command::new("p")
                .subcommand(clap::Command::new("a").arg(seed_option.clone()))
                .subcommand(clap::Command::new("b"))
        };
        let found = |line: &[&str]| seed(&command().get_matches_from(line));
        assert_eq!(found(&["p", "a"]), Some(7));
        assert_eq!(found(&["p", "a", "--seed", "3"]), Some(3));
        assert_eq!(found(&["p", "b"]), None);
    }
}
