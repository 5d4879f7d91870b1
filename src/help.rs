//! The program's own help: its commands under four headings.

use clap::{Command, Id};

/// Width of the list of commands, columns.
const COLUMNS: usize = 80;
/// Columns before the description of a command.
const INDENT: usize = 16;

/// The headings, each with its commands in the order in which they are used.
const HEADINGS: [(&str, &[&str]); 4] = [
    (
        "Build a map",
        &[
            "demo", "import", "check", "encode", "encoders", "train", "fit", "map", "export",
            "store",
        ],
    ),
    (
        "Ask a server",
        &[
            "catalog",
            "localize",
            "relocalize",
            "motion",
            "track",
            "navigate",
            "plan",
            "push",
            "pull",
        ],
    ),
    (
        "Run a server",
        &["serve", "config", "health", "completions", "man"],
    ),
    (
        "Research",
        &[
            "evaluate",
            "probe",
            "sweep",
            "cross-room",
            "benchmark",
            "card",
            "reproduce",
            "theory",
            "studio",
            "fit-tracking",
        ],
    ),
];

/// The command with its subcommands under their headings.
pub fn with_headings(command: Command) -> Command {
    let commands = commands_text(&command);
    // The list is part of the template, so it may not contain braces.
    command.help_template(format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{commands}\
         Options:\n{{options}}{{after-help}}"
    ))
}

/// The command with every default list as it is given on the command line, with commas.
pub fn with_comma_lists(mut command: Command) -> Command {
    let lists: Vec<(Id, String)> = command
        .get_arguments()
        .filter(|argument| argument.get_value_delimiter() == Some(','))
        .filter(|argument| argument.get_default_values().len() > 1)
        .map(|argument| {
            let values = argument.get_default_values().iter();
            let values: Vec<_> = values.map(|value| value.to_string_lossy()).collect();
            (argument.get_id().clone(), values.join(","))
        })
        .collect();
    for (id, list) in lists {
        command = command.mut_arg(id, |argument| argument.default_value(list));
    }

    let names: Vec<String> = command
        .get_subcommands()
        .map(|subcommand| subcommand.get_name().to_owned())
        .collect();
    for name in names {
        command = command.mut_subcommand(name, with_comma_lists);
    }
    command
}

fn commands_text(command: &Command) -> String {
    let mut text = String::new();
    for (heading, names) in HEADINGS {
        text.push_str(heading);
        text.push_str(":\n");
        for name in names {
            // A build without the feature "lab" lacks some commands.
            let Some(subcommand) = command.find_subcommand(name) else {
                continue;
            };
            let about = subcommand.get_about().map(ToString::to_string);
            let gap = INDENT - 2;
            text.push_str(&format!("  {name:<gap$}"));
            text.push_str(&wrapped(&about.unwrap_or_default()));
            text.push('\n');
        }
        text.push('\n');
    }
    text
}

/// The text in lines of at most `COLUMNS` columns, all but the first indented.
fn wrapped(text: &str) -> String {
    let mut wrapped = String::new();
    let mut column = INDENT;
    for word in text.split(' ') {
        let width = word.chars().count();
        if column > INDENT && column + 1 + width > COLUMNS {
            wrapped.push('\n');
            wrapped.push_str(&" ".repeat(INDENT));
            column = INDENT;
        } else if column > INDENT {
            wrapped.push(' ');
            column += 1;
        }
        wrapped.push_str(word);
        column += width;
    }
    wrapped
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use crate::Cli;
    use clap::CommandFactory;

    #[test]
    fn every_command_has_one_heading() {
        let listed: Vec<&str> = HEADINGS
            .iter()
            .flat_map(|(_, names)| *names)
            .copied()
            .collect();
        for command in Cli::command().get_subcommands() {
            let name = command.get_name();
            let count = listed.iter().filter(|&&other| other == name).count();
            assert_eq!(count, 1, "{name}");
        }
    }

    #[test]
    fn the_list_fits_eighty_columns() {
        let help = with_headings(Cli::command()).render_help().to_string();
        let (_, list) = help.split_once("\n\nBuild").unwrap();
        let list = list.split("Options:").next().unwrap();
        assert!(list.contains("Ask a server:\n  catalog"), "{list}");
        for line in list.lines() {
            assert!(line.chars().count() <= COLUMNS, "{line}");
        }
    }
}
