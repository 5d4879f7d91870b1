//! Each room learned by itself with one, two and four charts: in how many rooms that succeeds, and
//! how hard they are.

use rayon::prelude::*;
use serde_json::json;

use super::super::sweep::one::{content, done, row};
use super::{Found, Loaded, Set, Setting};
use crate::adapter::{Preset, TrainConfig};
use crate::pairs::Split;
use crate::report::{
    Section, SweepRow, configurations_rows, difficulty_rows, paper, parts_rows, success_rows,
};
use crate::training::Recipe;

/// Charts of the mixtures, the paper's.
const CHARTS: [usize; 3] = [1, 2, 4];

/// The paper's tables 2, of difficulty, of mixtures and of the parts of the motion.
pub fn section(setting: &Setting) -> anyhow::Result<Found> {
    let mut section = Section::new("Each room by itself: success, difficulty, mixtures of charts");

    let rows: Vec<SweepRow> = setting
        .sets
        .iter()
        .flat_map(|set| of_set(setting, set))
        .collect();

    section.text("Best run of each room, chosen by its test score as the paper's \"Max R²\" is:");
    let mut success = success_rows(&rows);
    for (recordings, encoder, [best, above_0, above_0_3]) in paper::SUCCESS {
        let format = format!("paper: {}", recordings.name);
        let features = encoder.to_owned();

        let numbers = [
            format!("{best:.3}"),
            format!("{above_0:.0}"),
            format!("{above_0_3:.0}"),
        ];

        success.push(
            [format, features, recordings.rooms.to_string()]
                .into_iter()
                .chain(numbers)
                .collect(),
        );
    }

    section.table(success);
    section.text("How hard the recordings are, over all features:");
    section.table(difficulty_rows(&rows));
    section.text("By charts (K), mean over rooms and seeds:");

    section.table(configurations_rows(
        &rows,
        CHARTS.len() * setting.sets.len(),
    ));

    section.text("By part of the motion, over all runs:");
    section.table(parts_rows(&rows));

    section.text(format!(
        "{} runs: every room that is held out or learned alone, with K of {CHARTS:?}, preset paper-base, stride {}, time \
         split, {} seeds. Choosing a run by its test score flatters it: the means are what to expect.",
        rows.len(),
        stride(setting),
        setting.options.seeds
    ));

    let mut failures: Vec<(&str, &str)> = rows
        .iter()
        .filter(|row| !row.failure.is_empty())
        .map(|row| (&*row.room, &*row.failure))
        .collect();
    failures.dedup();

    for (room, why) in failures {
        section.text(format!("Room {room} has no scores: {why}."));
    }

    Ok((section, json!(rows)))
}

/// The longest of the strides: 40 in the paper's sweep.
fn stride(setting: &Setting) -> u32 {
    setting
        .options
        .strides
        .iter()
        .copied()
        .max()
        .unwrap_or(setting.options.stride)
}

fn of_set(setting: &Setting, set: &Set) -> Vec<SweepRow> {
    let rooms: Vec<&Loaded> = set.test.iter().chain(&set.in_room).collect();

    let of_room = |room: &&Loaded| {
        let content = content(room);
        let mut rows = Vec::new();
        for charts in CHARTS {
            for seed in 0..setting.options.seeds {
                let plain =
                    setting.recipe(Preset::PaperBase, Split::Time, stride(setting), seed, None);
                let config = TrainConfig {
                    charts,
                    ..plain.config.clone()
                };
                let recipe = Recipe { config, ..plain };

                rows.push(done(room, &recipe, row(room, &content, &recipe)));
            }
        }

        rows
    };

    rooms.par_iter().flat_map(of_room).collect()
}
