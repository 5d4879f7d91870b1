//! How a tracker did, room by room and over all: `seese3 evaluate odometry`.

use serde_json::{Value, json};

use super::table::aligned;
use crate::eval::tracking::coverage;
use crate::scores::{Rate, mean};

/// A room that was followed.
#[derive(Debug, Clone)]
pub struct TrackedRoom {
    /// Its name.
    pub room: String,
    /// How it was recorded.
    pub format: String,
    /// Frames mapped, and frames followed.
    pub frames: [usize; 2],
    /// Root mean squares of the translation errors of dead reckoning and of the fused path, metres,
    /// without alignment.
    pub ape_m: [f64; 2],
    /// Those of the rotation errors, radians.
    pub ape_rad: [f64; 2],
    /// The same of relative errors of one frame, metres.
    pub rpe_m: [f64; 2],
    /// Squared Mahalanobis lengths of the errors of places, where the frames beside are mapped and
    /// where not.
    pub places: [Vec<f64>; 2],
    /// Of read motions, with the lengths of the motions.
    pub motions: Vec<(f64, f64)>,
    /// Shares of frames TRACKING, DEGRADED, LOST, RELOCALIZING.
    pub statuses: [f64; 4],
    /// Of the same stream when nothing was known at its beginning: the share LOST, and frames until
    /// the place was right.
    pub unknown: (f64, Option<usize>),
    /// Frames of other rooms that were followed here, from the beginning and after the room's own.
    pub foreign: [Foreign; 2],
}

/// Frames of other rooms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Foreign {
    /// That were followed.
    pub frames: usize,
    /// That were answered LOST.
    pub lost: usize,
}

/// Which room single views were thought to be in.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Relocalisation {
    /// Named, and right.
    pub right: usize,
    /// Named, and wrong.
    pub wrong: usize,
    /// Not named.
    pub ambiguous: usize,
    /// Rooms they were looked for in.
    pub rooms: usize,
}

/// Strata of the calibration report.
const STRATA: usize = 4;

/// A line a room, and the means.
pub fn odometry_table(rooms: &[TrackedRoom]) -> String {
    let head = [
        "room",
        "n",
        "odom m",
        "fused m",
        "ratio",
        "odom °",
        "fused °",
        "TRACKING",
        "DEGRADED",
        "LOST",
        "unknown: LOST",
        "found after",
    ];

    let mut lines = vec![head.map(str::to_owned).to_vec()];
    for room in rooms {
        lines.push(line(
            &room.room,
            room.frames[1].to_string(),
            std::slice::from_ref(room),
        ));
    }

    if rooms.len() > 1 {
        lines.push(line("mean", rooms.len().to_string(), rooms));
    }

    aligned(&lines)
}

fn line(name: &str, count: String, rooms: &[TrackedRoom]) -> Vec<String> {
    let of =
        |figure: &dyn Fn(&TrackedRoom) -> f64| mean(&rooms.iter().map(figure).collect::<Vec<_>>());
    let odom = of(&|room| room.ape_m[0]);
    let fused = of(&|room| room.ape_m[1]);

    let found: Vec<f64> = rooms
        .iter()
        .filter_map(|room| room.unknown.1)
        .map(|frames| frames as f64)
        .collect();

    let found = match found.len() {
        0 => "never".to_owned(),
        // Of those that were found.
        some if some < rooms.len() => format!(
            "{:.0} ({some} of {})",
            crate::scores::median(&found),
            rooms.len()
        ),
        _ => format!("{:.0}", crate::scores::median(&found)),
    };

    vec![
        name.to_owned(),
        count,
        format!("{odom:.3}"),
        format!("{fused:.3}"),
        format!("{:.3}", fused / odom),
        format!("{:.2}", of(&|room| room.ape_rad[0].to_degrees())),
        format!("{:.2}", of(&|room| room.ape_rad[1].to_degrees())),
        format!("{:.3}", of(&|room| room.statuses[0])),
        format!("{:.3}", of(&|room| room.statuses[1])),
        format!("{:.3}", of(&|room| room.statuses[2])),
        format!("{:.3}", of(&|room| room.unknown.0)),
        found,
    ]
}

/// Nominal against measured: places, motions, motions by their length.
pub fn coverage_table(rooms: &[TrackedRoom]) -> String {
    let mut lines = vec![
        ["errors", "n", "within 68 %", "within 95 %"]
            .map(str::to_owned)
            .to_vec(),
    ];

    let mut row = |name: String, surprises: &[f64]| {
        let [inner, outer] = coverage(surprises);
        lines.push(vec![
            name,
            surprises.len().to_string(),
            format!("{inner:.3}"),
            format!("{outer:.3}"),
        ]);
    };

    let places = |at: usize| {
        rooms
            .iter()
            .flat_map(|room| room.places[at].clone())
            .collect::<Vec<f64>>()
    };

    for (at, name) in ["places, way mapped", "places, way not mapped"]
        .into_iter()
        .enumerate()
    {
        if !places(at).is_empty() {
            row(name.to_owned(), &places(at));
        }
    }

    row("places, all".to_owned(), &[places(0), places(1)].concat());
    let mut motions: Vec<(f64, f64)> = rooms.iter().flat_map(|room| room.motions.clone()).collect();
    row(
        "motions".to_owned(),
        &motions.iter().map(|motion| motion.1).collect::<Vec<_>>(),
    );

    motions.sort_by(|a, b| a.0.total_cmp(&b.0));

    for part in motions.chunks(motions.len().div_ceil(STRATA).max(1)) {
        let low = part[0].0;
        let high = part[part.len() - 1].0;
        row(
            format!("motions of {low:.2} to {high:.2}"),
            &part.iter().map(|motion| motion.1).collect::<Vec<_>>(),
        );
    }

    aligned(&lines)
}

/// Frames of other rooms answered LOST, in words.
pub fn foreign_text(rooms: &[TrackedRoom]) -> String {
    let line = |(at, when): (usize, &str)| {
        let sum = |of: fn(&Foreign) -> usize| {
            rooms
                .iter()
                .map(|room| of(&room.foreign[at]))
                .sum::<usize>()
        };
        let frames = sum(|foreign| foreign.frames);

        let lost = sum(|foreign| foreign.lost);
        let rate = Rate::of(lost, frames);

        format!(
            "frames of other rooms answered LOST, {when}: {lost} of {frames} ({:.4} [{:.4}, {:.4}])\n",
            rate.rate, rate.low, rate.high
        )
    };

    [(0, "from the beginning"), (1, "after the room's own")]
        .map(line)
        .concat()
}

impl Relocalisation {
    /// In words.
    pub fn text(&self) -> String {
        let count = self.right + self.wrong + self.ambiguous;
        let share = |n: usize| n as f64 / count.max(1) as f64;

        format!(
            "single views among {} rooms: {:.4} right, {:.4} wrong, {:.4} ambiguous, of {count}",
            self.rooms,
            share(self.right),
            share(self.wrong),
            share(self.ambiguous)
        )
    }
}

/// All of it.
pub fn odometry_json(rooms: &[TrackedRoom], relocalisation: Option<&Relocalisation>) -> Value {
    let room = |room: &TrackedRoom| {
        let motions: Vec<f64> = room.motions.iter().map(|motion| motion.1).collect();
        json!({
            "room": room.room, "format": room.format, "mapped": room.frames[0], "followed": room.frames[1],
            "ape_translation_rmse_m": { "odom": room.ape_m[0], "fused": room.ape_m[1] },
            "ape_rotation_rmse_rad": { "odom": room.ape_rad[0], "fused": room.ape_rad[1] },
            "rpe_translation_rmse_m": { "odom": room.rpe_m[0], "fused": room.rpe_m[1] },
            "coverage_places": coverage(&room.places.concat()), "coverage_motions": coverage(&motions),
            "tracking": room.statuses[0], "degraded": room.statuses[1], "lost": room.statuses[2],
            "relocalizing": room.statuses[3],
            "lost_without_initial_pose": room.unknown.0, "frames_to_relocalise": room.unknown.1,
            "foreign": room.foreign.map(|foreign| json!({ "frames": foreign.frames, "lost": foreign.lost })),
        })
    };

    let relocalisation = relocalisation.map(|found| {
        json!({ "rooms": found.rooms, "right": found.right, "wrong": found.wrong, "ambiguous": found.ambiguous })
    });

    let places: Vec<f64> = rooms.iter().flat_map(|room| room.places.concat()).collect();

    let motions: Vec<f64> = rooms
        .iter()
        .flat_map(|room| room.motions.iter().map(|motion| motion.1))
        .collect();

    json!({
        "rooms": rooms.iter().map(room).collect::<Vec<_>>(),
        "coverage_places": coverage(&places),
        "coverage_motions": coverage(&motions),
        "relocalisation": relocalisation,
        "ape_formula": super::APE_FORMULA,
        "rpe_formula": super::RPE_FORMULA,
        "alignment": "none",
    })
}
