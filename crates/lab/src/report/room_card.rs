//! Statistics of recordings as a table.

use super::table::Column::{self, Text};
use super::table::Table;
use crate::experiments::room_card::{MedianError, RoomCard};
use seese3_core::statistics::median;

/// One line per room, and a line of medians if there are several.
pub fn room_card_table(cards: &[RoomCard]) -> Table {
    let columns: [Column<RoomCard>; 14] = [
        Text("room", |card| card.room.clone()),
        Text("frames", |card| card.frames.to_string()),
        Text("visits", |card| card.visits.to_string()),
        Text("m in 20 frames", |card| known(card.step_m, 3)),
        Text("° in 20 frames", |card| known(card.step_deg, 1)),
        Text("persistence of v after 1, 10, 20", |card| {
            three(card.persistence_v)
        }),
        Text("of ω", |card| three(card.persistence_w)),
        Text("revisited", |card| known(card.revisited, 2)),
        Text("overlap of visits", |card| {
            card.overlap.map_or(String::new(), |share| known(share, 2))
        }),
        Text("across visits by feature", |card| {
            error_text(card.across_by_feature)
        }),
        Text("by pose", |card| error_text(card.across_by_pose)),
        Text("participation ratio", |card| {
            known(card.participation_ratio, 1)
        }),
        Text("feature step", |card| known(card.feature_step, 2)),
        Text("recorded as", |card| card.format.clone()),
    ];

    let mut lines = cards.to_vec();
    lines.extend((cards.len() > 1).then(|| medians(cards)));
    Table::of(&lines, &columns)
}

/// The medians over rooms; of the rooms with several visits where a single one has no value.
pub fn medians(cards: &[RoomCard]) -> RoomCard {
    let of = |of: &dyn Fn(&RoomCard) -> f64| {
        let values: Vec<f64> = cards.iter().map(of).filter(|x| !x.is_nan()).collect();
        median(&values)
    };
    let three =
        |values: fn(&RoomCard) -> [f64; 3]| [0, 1, 2].map(|at| of(&|card| values(card)[at]));
    let of_several = |of: fn(&RoomCard) -> Option<f64>| {
        let values: Vec<f64> = cards.iter().filter_map(of).collect();
        (!values.is_empty()).then(|| median(&values))
    };
    let error = |of: fn(&RoomCard) -> Option<MedianError>| {
        let errors: Vec<MedianError> = cards.iter().filter_map(of).collect();
        let column =
            |of: fn(&MedianError) -> f64| median(&errors.iter().map(of).collect::<Vec<_>>());
        (!errors.is_empty()).then(|| MedianError {
            translation_m: column(|error| error.translation_m),
            rotation_deg: column(|error| error.rotation_deg),
        })
    };
    let count = |of: fn(&RoomCard) -> usize| {
        let counts: Vec<f64> = cards.iter().map(|card| of(card) as f64).collect();
        median(&counts).round() as usize
    };

    RoomCard {
        room: format!("median of {}", cards.len()),
        format: String::new(),
        frames: count(|card| card.frames),
        visits: count(|card| card.visits),
        step_m: of(&|card| card.step_m),
        step_deg: of(&|card| card.step_deg),
        persistence_v: three(|card| card.persistence_v),
        persistence_w: three(|card| card.persistence_w),
        revisited: of(&|card| card.revisited),
        overlap: of_several(|card| card.overlap),
        across_by_feature: error(|card| card.across_by_feature),
        across_by_pose: error(|card| card.across_by_pose),
        participation_ratio: of(&|card| card.participation_ratio),
        feature_step: of(&|card| card.feature_step),
    }
}

fn three(values: [f64; 3]) -> String {
    values.map(|value| known(value, 2)).join(", ")
}

/// The number, or a dash where the recording is too short for it.
fn known(value: f64, decimals: usize) -> String {
    match value.is_nan() {
        true => "–".to_owned(),
        false => format!("{value:.decimals$}"),
    }
}

fn error_text(error: Option<MedianError>) -> String {
    error.map_or(String::new(), |error| {
        format!("{:.2} m {:.1}°", error.translation_m, error.rotation_deg)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn what_a_short_recording_lacks_is_a_dash() {
        assert_eq!(three([0.5, f64::NAN, f64::NAN]), "0.50, –, –");
        assert_eq!(known(12.345, 1), "12.3");
    }
}
