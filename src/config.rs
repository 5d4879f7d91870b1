//! The configuration file of `serve`, and `seese3 config`, which checks and prints it.
//!
//! ```toml
//! store = "/var/lib/seese3"
//! listen = "0.0.0.0:50051"
//! metrics-listen = "127.0.0.1:9090"
//! encoder = ["builtin", "/etc/seese3/effnetlite0.onnx"]
//! max-streams = 64
//! ```
//!
//! A key is a flag of `serve` without its leading dashes; a value is the flag's value. The file,
//! the environment and the command line therefore share one list of settings, one validation and
//! one help text. Flags override environment variables, which override the file.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, CommandFactory, FromArgMatches, Subcommand};

use super::Cli;
use super::examples::with_examples;
use super::help::{with_comma_lists, with_headings};
use super::made_by::remember_call;
use super::output::say;
use super::serve::Serve;

/// Environment variable with the path of the file.
const VARIABLE: &str = "SEESE3_CONFIG";
/// Smallest similarity, 0 to 1, at which an unknown key is reported as a misspelling of a known
/// one.
const NEARLY: f64 = 0.75;

/// Check or print the settings of `serve`
#[derive(Debug, Args)]
pub struct Config {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Exit with status 0 if `serve` would accept these settings and the files that they name
    Check(Serve),
    /// Print the effective settings of `serve`, each with its source
    Print(Print),
}

#[derive(Debug, Args)]
struct Print {
    #[command(flatten)]
    _serve: Serve,
    /// Effective settings, filled in by [`Config::remember`].
    #[arg(skip)]
    settings: Vec<Setting>,
}

/// An effective setting and its source.
#[derive(Debug, Clone)]
struct Setting {
    key: String,
    values: Vec<String>,
    source: &'static str,
}

impl Config {
    pub fn run(self) -> anyhow::Result<()> {
        match self.action {
            Action::Check(serve) => {
                serve.check()?;
                say("the settings are valid");
            }
            Action::Print(print) => {
                for setting in print.settings {
                    say(setting);
                }
            }
        }

        Ok(())
    }

    /// Stores the effective settings for `config print`.
    pub(super) fn remember(&mut self, matches: &ArgMatches) {
        if let Action::Print(print) = &mut self.action
            && let Some(matches) = matches
                .subcommand_matches("config")
                .and_then(|config| config.subcommand_matches("print"))
        {
            print.settings = settings(matches);
        }
    }
}

impl std::fmt::Display for Setting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            key,
            values,
            source,
        } = self;

        let quoted: Vec<String> = values
            .iter()
            .map(|value| match value.parse::<i64>() {
                Ok(_) => value.clone(),
                // JSON string escapes are also valid in TOML basic strings.
                Err(_) => serde_json::Value::from(value.as_str()).to_string(),
            })
            .collect();
        match quoted.as_slice() {
            [only] => write!(f, "{key} = {only}  # {source}"),
            several => write!(f, "{key} = [{}]  # {source}", several.join(", ")),
        }
    }
}

/// Parses the command line. For `serve` and `config`, the values of the configuration file become
/// argument defaults.
///
/// # Errors
/// If the file cannot be read or has an unknown key. Clap prints its own errors and exits.
pub fn parse() -> anyhow::Result<Cli> {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let mut command = with_headings(with_examples(with_comma_lists(Cli::command())));

    let reads_file = arguments
        .get(1)
        .is_some_and(|name| name == "serve" || name == "config");
    if reads_file && let Some(file) = file_of(&arguments) {
        let text = seese3_files::read_text(&file, seese3_files::SMALL_FILE_BYTES)
            .with_context(|| format!("--config: {} cannot be read", file.display()))?;
        let given = defaults(&file, &text)?;

        command = command.mut_subcommand("serve", |serve| with_defaults(serve, &given));
        command = command.mut_subcommand("config", |config| {
            config
                .mut_subcommand("check", |check| with_defaults(check, &given))
                .mut_subcommand("print", |print| with_defaults(print, &given))
        });
    }

    let matches = command.get_matches_from(&arguments);
    remember_call(&arguments, &matches);
    let mut cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    cli.remember(&matches);
    Ok(cli)
}

/// Path of the configuration file: from the command line, else from the environment.
///
/// Needed before the command line is parsed, because the file may supply required arguments.
fn file_of(arguments: &[OsString]) -> Option<PathBuf> {
    let mut rest = arguments.iter();
    while let Some(argument) = rest.next() {
        if argument == "--config" {
            return rest.next().map(PathBuf::from);
        }
        let text = argument.to_string_lossy();
        if let Some(file) = text.strip_prefix("--config=") {
            return Some(PathBuf::from(file));
        }
    }

    std::env::var_os(VARIABLE).map(PathBuf::from)
}

/// Settings of a file as pairs of clap argument id and values.
fn defaults(file: &Path, text: &str) -> anyhow::Result<Vec<(String, Vec<String>)>> {
    let place = file.display();
    let table: toml::Table = text.parse().with_context(|| format!("--config: {place}"))?;
    let serve = Serve::augment_args(Command::new("serve"));
    let known: Vec<String> = serve
        .get_arguments()
        .filter_map(|argument| argument.get_long().map(str::to_owned))
        .filter(|long| long != "config")
        .collect();

    let mut given = Vec::new();
    for (key, value) in table {
        let argument = serve
            .get_arguments()
            .find(|argument| known.contains(&key) && argument.get_long() == Some(key.as_str()));
        let Some(argument) = argument else {
            let nearest = known
                .iter()
                .map(|known| (strsim::normalized_damerau_levenshtein(known, &key), known))
                .filter(|(likeness, _)| *likeness >= NEARLY)
                .max_by(|a, b| a.0.total_cmp(&b.0));
            match nearest {
                Some((_, nearest)) => {
                    bail!("--config: {place}: '{key}' is not a setting; did you mean '{nearest}'?")
                }
                None => bail!(
                    "--config: {place}: '{key}' is not a setting; use a flag of `seese3 serve` without its dashes"
                ),
            }
        };

        let values = values(value).with_context(|| {
            format!("--config: {place}: '{key}' must be text, a number, or a list of them")
        })?;
        given.push((argument.get_id().to_string(), values));
    }

    Ok(given)
}

/// A TOML value as command-line values. `None` for a boolean, a date or a table.
fn values(value: toml::Value) -> Option<Vec<String>> {
    match value {
        toml::Value::String(text) => Some(vec![text]),
        toml::Value::Integer(number) => Some(vec![number.to_string()]),
        toml::Value::Float(number) => Some(vec![number.to_string()]),
        toml::Value::Array(list) => {
            let each: Option<Vec<Vec<String>>> = list.into_iter().map(values).collect();
            each.map(|each| each.concat())
        }
        toml::Value::Boolean(_) | toml::Value::Datetime(_) | toml::Value::Table(_) => None,
    }
}

fn with_defaults(mut command: Command, given: &[(String, Vec<String>)]) -> Command {
    for (id, values) in given {
        command = command.mut_arg(id, |argument| {
            argument.required(false).default_values(values.clone())
        });
    }
    command
}

/// All effective settings.
fn settings(matches: &ArgMatches) -> Vec<Setting> {
    let serve = Serve::augment_args(Command::new("serve"));
    let of_argument = |argument: &clap::Arg| {
        let key = argument.get_long().filter(|key| *key != "config")?;
        let id = argument.get_id().as_str();
        let values: Vec<String> = matches
            .get_raw(id)?
            .map(|value| value.to_string_lossy().into_owned())
            .collect();

        let is_own_default = argument
            .get_default_values()
            .iter()
            .map(|value| value.to_string_lossy().into_owned())
            .eq(values.iter().cloned());
        let source = match matches.value_source(id)? {
            ValueSource::CommandLine => "command line",
            ValueSource::EnvVariable => "environment",
            _ if is_own_default => "default",
            _ => "file",
        };

        Some(Setting {
            key: key.to_owned(),
            values,
            source,
        })
    };

    serve.get_arguments().filter_map(of_argument).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Vec<(String, Vec<String>)>, String> {
        defaults(Path::new("seese3.toml"), text).map_err(|error| format!("{error:#}"))
    }

    /// Oracle: the flags of `serve`, and TOML.
    #[test]
    fn keys_are_flags_and_others_are_refused_with_a_suggestion() {
        let given = read("max-streams = 7\nencoder = [\"builtin\", \"a.onnx\"]").unwrap();
        let wanted = [
            (
                "encoders".to_owned(),
                vec!["builtin".to_owned(), "a.onnx".to_owned()],
            ),
            ("max_streams".to_owned(), vec!["7".to_owned()]),
        ];
        assert_eq!(given, wanted);

        for (text, word) in [
            ("max-stream = 7", "did you mean 'max-streams'"),
            ("color = \"red\"", "'color' is not a setting"),
            ("queue = true", "'queue' must be"),
            ("queue = ", "seese3.toml"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(word), "{error}");
        }
    }
}
