//! Usage examples for every command's help. A test parses each one.

use clap::Command;

/// Exit codes and environment, shown at the end of the program's help.
const EXIT_CODES: &str = "Exit codes:\n  \
    0    done\n  \
    1    failed; the last line on standard error gives the cause and the remedy\n  \
    2    invalid command line\n  \
    130  stopped by Ctrl-C (serve: 0)\n\n\
    NO_COLOR=1 turns colors off. Progress goes to standard error: a bar on a terminal, otherwise a line\n\
    every 30 s; --quiet turns it off.";

/// Command paths, each with its examples below it.
const EXAMPLES: &str = "\
demo
  seese3 demo
  seese3 demo --seed 2 --out another-room
import
  seese3 import folder photos --name kitchen --store store
  seese3 import colmap project --store store --scale 1
  seese3 import bag rosbag2_hall --name hall --store store --image-topic /camera/image/compressed
  seese3 import numpy --poses poses.npy --features mine=features.npy --name kitchen --store store
import folder
  seese3 import folder photos --name kitchen --store store
import colmap
  seese3 import colmap project --name kitchen --store store --scale 0.37
import 7scenes
  seese3 import 7scenes kitchen --store store --every 2
import numpy
  seese3 import numpy --poses poses.npy --features mine=features.npy --name kitchen --store store
import bag
  seese3 import bag rosbag2_hall --store store --image-topic /camera/image/compressed --pose-topic /odom
  seese3 import bag drive.mcap --name hall --store store --world-frame map
check
  seese3 check --store store --room kitchen
  seese3 check --store store --room kitchen --json - | jq .warnings
export
  seese3 export numpy --store store --room kitchen --out kitchen-numpy
  seese3 export tum --store store --room kitchen --out kitchen.tum --rate 30
encode
  seese3 encode --store store --room kitchen --encoder pixels
  seese3 encode --store store --room kitchen --encoder effnetlite0.onnx --recipe effnetlite0 --layers block14
  seese3 encode --store store --room kitchen --encoder vit.onnx --resize 224x224 --preprocess imagenet --pool cls
  seese3 encode --store store --room 'scene*' --shard 3/16 --encoder vit.onnx --recipe dinov2-b --runtime onnxruntime --device cuda:0
encoders
  seese3 encoders
  seese3 encoders dinov2-b
studio
  seese3 studio --rooms 20 --frames 400 --seed 7 --store suite --keep-images
  seese3 studio --suite returns --rooms 3 --frames 600 --store returns --encoder pixels
train
  seese3 train --store store --room kitchen --features pixels --stride 20 --split blocks
  seese3 train --store suite --room 'studio7-000*' --preset steady --split whole --calibrate-on 'studio7-001*' --name robot
fit
  seese3 fit --store store --room kitchen --adapter robot
fit-tracking
  seese3 fit-tracking --store store --room 'hall-*' --check office --adapter robot --json fitted.json
  seese3 fit-tracking --store store --room hall --publish
map
  seese3 map crop --store store --room hall --box -2,-1,0,6,4,3 --name hall-west
  seese3 map merge --store store --room hall --add office --align --name floor
map crop
  seese3 map crop --store store --room hall --rows 0..200 --name hall-begin
map transform
  seese3 map transform --store store --room hall --matrix site_from_hall.txt --name hall-site
map align
  seese3 map align --store store --room office --to hall --with-scale --name office-in-hall
map merge
  seese3 map merge --store store --room hall --add office --align --name floor
evaluate
  seese3 evaluate --store store --room kitchen --exclude-source
  seese3 evaluate --store store --room kitchen --plot hit.svg --table hit.tex --json hit.json
  seese3 evaluate odometry --store store --room kitchen --adapter robot --hold-out blocks
evaluate localization
  seese3 evaluate localization --store store --room kitchen --fit --map-blocks
  seese3 evaluate localization --store store --room kitchen --peer python3 --peer-every 10
evaluate motion
  seese3 evaluate motion --store store --room kitchen --adapter robot --stride 5
evaluate odometry
  seese3 evaluate odometry --store store --room kitchen --adapter robot --hold-out blocks --json -
evaluate planning
  seese3 evaluate planning --store store --room kitchen --adapter robot
evaluate robustness
  seese3 evaluate robustness --store store --room kitchen --adapter robot --encoder effnetlite0.onnx
evaluate trajectory
  seese3 evaluate trajectory --reference truth.tum --estimate run.tum
probe
  seese3 probe --store store --room kitchen --features pixels --stride 20 --split folds
benchmark
  seese3 benchmark freeze --store suite --room 'studio7-*' --name rooms-7 --out rooms-7.json
  seese3 benchmark score --benchmark rooms-7.json --store suite --submission mine.json --page results.md
benchmark freeze
  seese3 benchmark freeze --store suite --room 'studio7-*' --stride 25 --name rooms-7 --out rooms-7.json
benchmark answer
  seese3 benchmark answer --benchmark rooms-7.json --store suite --adapter robot --name mine --about pixels --out mine.json
benchmark check
  seese3 benchmark check --benchmark rooms-7.json --submission mine.json
benchmark score
  seese3 benchmark score --benchmark rooms-7.json --store suite --submission mine.json --submission other.json --page results.md
benchmark probe
  seese3 benchmark probe --benchmark rooms-7.json --store suite --features pixels --about pixels --out pixels.json
benchmark encoders
  seese3 benchmark encoders --benchmark rooms-7.json --metrics pixels.json --metrics mine.json --page encoders.md
card
  seese3 card --store suite --room 'studio7-*' --features pixels --medians
cross-room
  seese3 cross-room --store suite --train 'studio7-000*' --test 'studio7-001*' --sizes 5,10
sweep
  seese3 sweep layers --store store --room kitchen --stride 20
  seese3 sweep adapters --store store --room kitchen --features pixels --seeds 5 --out sweep
sweep layers
  seese3 sweep layers --store store --room kitchen --stride 20 --json layers.json
sweep adapters
  seese3 sweep adapters --store store --room kitchen --features pixels --seeds 5 --out sweep --shard 1/2
sweep formulations
  seese3 sweep formulations --store store --room kitchen --features pixels --split folds
reproduce
  seese3 reproduce --store suite --train 'studio7-000*' --test 'studio7-001*' --in-room studio7-0000 --features builtin --out report
theory
  seese3 theory --json theory.json
serve
  seese3 serve --store store
  seese3 serve --store store --encoder effnetlite0.onnx --listen 0.0.0.0:50051 --writable
  seese3 serve --store store --config server.toml
store
  seese3 store list --store store
  seese3 store rm --store store rooms/kitchen/revisions/1
  seese3 store gc --store store --dry-run
store list
  seese3 store list --store store --json -
store show
  seese3 store show --store store rooms/kitchen
store default
  seese3 store default --store store
  seese3 store default --store store rooms/kitchen adapters/base
  seese3 store default --store store adapters/base/revisions/2
  seese3 store default --store store adapters/base --unset
  seese3 store default --store store --back
store rm
  seese3 store rm --store store rooms/kitchen/revisions/1 --dry-run
store gc
  seese3 store gc --store store --older-than 86400
store verify
  seese3 store verify --store store
push
  seese3 push --store store rooms/kitchen --server 127.0.0.1:50051 --fit
pull
  seese3 pull --store store rooms/kitchen --server 127.0.0.1:50051
  seese3 pull --store store adapters/base/revisions/2 --as base-2
config
  seese3 config check --store store --config server.toml
  seese3 config print --store store
navigate
  seese3 navigate --room kitchen --from 100 --to 140 --steps 4 --mode closed-loop
  seese3 navigate --room kitchen --image photo.jpg --twist 0,0,0.5,0,0,0 --json -
plan
  seese3 plan --room kitchen --from 100 --to 140
  seese3 plan --room kitchen --image photo.jpg --camera mapping --to-pose 1.5,0,2,0,0,0,1
localize
  seese3 localize --room kitchen --image photo.jpg
  seese3 localize --feature-file features.npy --row 7 --top-k 3 --json -
relocalize
  seese3 relocalize --images before.jpg,now.jpg --camera mapping
  seese3 relocalize --room kitchen --feature-file features.npy --rows 3,4,5
motion
  seese3 motion --images a.jpg,b.jpg --camera 640x480,525
  seese3 motion --room kitchen --from 100 --to 110
track
  seese3 track --room kitchen --images frames --rate 30 --tum path.tum --mcap run.mcap
  seese3 track --room kitchen --feature-file features.npy --json - | jq .status
catalog
  seese3 catalog
  seese3 catalog --server robot:50051 --json -
health
  seese3 health
  seese3 health rooms/kitchen
completions
  seese3 completions bash > ~/.local/share/bash-completion/completions/seese3
man
  seese3 man --out ~/.local/share/man/man1
";

/// The command paths, each with its examples.
fn examples() -> Vec<(Vec<&'static str>, Vec<&'static str>)> {
    let mut examples: Vec<(Vec<&str>, Vec<&str>)> = Vec::new();
    for line in EXAMPLES.lines() {
        match (line.strip_prefix("  "), examples.last_mut()) {
            (Some(example), Some((_, of_path))) => of_path.push(example),
            _ => examples.push((line.split(' ').collect(), Vec::new())),
        }
    }
    examples
}

/// Adds the exit codes and the examples to the help of `command`.
pub fn with_examples(command: Command) -> Command {
    let mut command = command.after_help(EXIT_CODES);
    for (path, examples) in examples() {
        let title = if examples.len() == 1 {
            "Example"
        } else {
            "Examples"
        };
        let text = format!("{title}:\n  {}", examples.join("\n  "));
        command = with_text(command, &path, &text);
    }
    command
}

/// Appends a text to the help of the subcommand at `path`, if this build has it.
fn with_text(command: Command, path: &[&str], text: &str) -> Command {
    let [first, rest @ ..] = path else {
        let before = command.get_after_help().map(ToString::to_string);
        let text = before.map_or_else(|| text.to_owned(), |before| format!("{before}\n\n{text}"));
        return command.after_help(text);
    };

    if command.find_subcommand(first).is_none() {
        return command;
    }
    command.mut_subcommand(*first, |inner| with_text(inner, rest, text))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use crate::Cli;
    use clap::CommandFactory;

    /// Splits a line into words as a shell does, for lines without pipes and redirections.
    fn words(line: &str) -> impl Iterator<Item = &str> {
        line.split_whitespace().map(|word| word.trim_matches('\''))
    }

    /// Oracle: the parser itself.
    #[cfg(feature = "lab")]
    #[test]
    fn every_example_is_understood() {
        for (path, examples) in examples() {
            for example in examples {
                let before_pipe = example.split(['|', '>']).next().unwrap();
                let parsed = Cli::command().try_get_matches_from(words(before_pipe));
                assert!(
                    parsed.is_ok(),
                    "{path:?}: {example}: {}",
                    parsed.unwrap_err()
                );
            }
        }
    }

    #[test]
    fn every_command_has_an_example() {
        fn check(command: &Command, path: &str) {
            for inner in command.get_subcommands() {
                // Dataset formats and file formats differ only in their names.
                if inner.get_name() == "help" || matches!(path, "import" | "export" | "config") {
                    continue;
                }
                let help = inner.get_after_help().map(ToString::to_string);
                let has_example = help.is_some_and(|help| help.contains("Example"));
                assert!(has_example, "{path} {} has no example", inner.get_name());
                check(inner, inner.get_name());
            }
        }

        check(&with_examples(Cli::command()), "");
    }
}
