//! Section: probes M1 to M3 of the in-room rooms and of the held-out rooms.

use rayon::prelude::*;
use serde::Serialize;

use seese3_core::splits::Split;
use seese3_core::statistics::mean_of_known;
use seese3_core::training::RoomData;

use super::claims::{Case, Claim, encoders_and_control};
use super::{Error, Found, Reproduction, paper};
use crate::experiments::Within;
use crate::experiments::cross_room::clipped_r2;
use crate::experiments::folds::FoldedMotions;
use crate::probes::{MutualKnn, PoseDistance, intrinsic_dimension, mutual_knn, ridge_probe};
use crate::report::{Axes, Figure, Section, Series, Table, fixed};

/// An M3 R² up to this one is "near zero": the paper's largest is 0.09 (V-JEPA 2.1).
const LARGEST_LINEAR_R2: f64 = 0.1;

/// The probes of one room: a row of the record.
#[derive(Debug, Serialize)]
pub struct ProbeRecord {
    features: String,
    room: String,
    m1_short: f64,
    m1_long: f64,
    /// M1 at the long stride by the norm of twists.
    m1_long_twist: f64,
    twonn: f64,
    mle: f64,
    /// R² over the pairs of all five folds together, like `constant`.
    m3: f64,
    constant: f64,
}

impl ProbeRecord {
    /// The numbers in table column order.
    fn numbers(&self) -> [f64; 7] {
        [
            self.m1_short,
            self.m1_long,
            self.m1_long_twist,
            self.twonn,
            self.mle,
            self.m3,
            self.constant,
        ]
    }
}

/// Builds the section with M1 at a short and a long stride, M2 and M3.
pub fn section(given: &Reproduction<'_>) -> Result<Found<Vec<ProbeRecord>>, Error> {
    // Probes use no other rooms, so the held-out rooms are probed too. They train no adapter, so a
    // room has one value per probe and no spread over seeds.
    let mut by_set: Vec<Vec<ProbeRecord>> = Vec::new();
    for set in &given.sets {
        let rooms: Vec<&RoomData<'_>> = set.in_room.iter().chain(&set.test).collect();
        let probed = rooms
            .into_par_iter()
            .map(|room| probed(room, &set.features, given));
        by_set.push(probed.collect::<Result<_, Error>>()?);
    }

    let mut section = Section::new("Probes: M1, M2, M3");
    section.table(table(given, &by_set));
    section.text(format!(
        "M1: at most {} frames, k = 10; the 10 frames before and after a frame are no neighbors of it. Short: consecutive \
         frames. Long: the smallest stride at which the frames span the recording. M2: no gap, as in the paper. M3, and as \
         'constant' the mean training motion: stride {}, five folds scored together.",
        MutualKnn::default().frames,
        given.options.stride
    ));

    // One point per room: M1 at the short stride against M1 at the long one.
    let series = given.sets.iter().zip(&by_set).map(|(set, probed)| {
        let points = probed.iter().map(|room| [room.m1_short, room.m1_long]);
        Series::dots(&set.features, points.collect())
    });
    let curves = Figure {
        axes: Axes::Diagonal,
        ..Figure::new(
            "Mutual k-NN, short against long stride",
            "short stride",
            "long stride",
            series.collect(),
        )
    };
    section.picture(
        "m1.svg",
        curves.svg()?,
        "M1 at a short and a long stride, a point a room; the line is y = x",
    );

    let claims = claims_of(given, &by_set);
    Ok(Found {
        section,
        record: by_set.into_iter().flatten().collect(),
        claims,
    })
}

/// One row per in-room room, and one for the held-out rooms together; the paper's rows
/// follow.
fn table(given: &Reproduction<'_>, by_set: &[Vec<ProbeRecord>]) -> Table {
    let mut table = Table::new(
        "features | room | M1 short | M1 long | M1 long, by twist | TwoNN | MLE | M3 R² | constant",
    );

    for (set, probed) in given.sets.iter().zip(by_set) {
        let mut add = |room: String, numbers: [f64; 7]| {
            table.row(
                &set.features,
                std::iter::once(room).chain(fixed(numbers, 3)),
            );
        };

        let (alone, held_out) = probed.split_at(set.in_room.len());
        for room in alone {
            add(room.room.clone(), room.numbers());
        }
        let mean = std::array::from_fn(|column| {
            let values: Vec<f64> = held_out.iter().map(|room| room.numbers()[column]).collect();
            mean_of_known(&values)
        });
        add(format!("mean of {} held out", held_out.len()), mean);
    }

    // The paper's rows have only M2 and M3.
    for (encoder, numbers) in paper::DIMENSIONS {
        let [twonn, mle, m3] = fixed(numbers, 2);
        let empty = String::new;
        table.row(
            format!("paper: {encoder}"),
            [empty(), empty(), empty(), empty(), twonn, mle, m3, empty()],
        );
    }

    table
}

/// The claims on M1 to M3 of the trained encoders. By convention the last feature set is the
/// control, which needs no trained encoder.
fn claims_of(given: &Reproduction<'_>, by_set: &[Vec<ProbeRecord>]) -> Vec<Claim> {
    let (trained, control) = encoders_and_control(by_set);
    let encoders = || {
        let names = given.sets.iter().map(|set| set.features.as_str());
        names.zip(trained)
    };
    let of = |set: &[ProbeRecord], value: fn(&ProbeRecord) -> f64| -> Vec<f64> {
        set.iter().map(value).collect()
    };
    let long = |set: &[ProbeRecord]| of(set, |room| room.m1_long);

    let topology = control.into_iter().flat_map(|control| {
        encoders().map(|(name, set)| Case::of_difference(name, &long(set), &long(control)))
    });
    let dimension = encoders().flat_map(|(name, set)| {
        let two_nn = margin_around_six(&of(set, |room| room.twonn));
        let mle = margin_around_six(&of(set, |room| room.mle));
        [
            Case::of_rooms(format!("{name}, TwoNN"), &two_nn),
            Case::of_rooms(format!("{name}, MLE"), &mle),
        ]
    });
    let linear = encoders().map(|(name, set)| {
        let margin = of(set, |room| LARGEST_LINEAR_R2 - clipped_r2(room.m3));
        Case::of_rooms(name, &margin)
    });

    vec![
        Claim::new(
            "topology: a trained encoder's neighbors at a long stride are neighbors by pose, more than raw pixels' (M1)",
            "M1 at the long stride minus that of the control",
            topology.collect(),
        ),
        Claim::new(
            "the intrinsic dimension of features is near 6 (M2)",
            "distance of the room's dimension from the nearer end of 5 to 7; negative outside",
            dimension.collect(),
        ),
        Claim::new(
            "no feature is linear in motion by itself: ridge regression has an R² of at most 0.1 (M3)",
            "0.1, about the paper's largest R², minus max(R², −1)",
            linear.collect(),
        ),
    ]
}

/// For each dimension, how far it is inside the range 5 to 7; negative outside.
fn margin_around_six(dimensions: &[f64]) -> Vec<f64> {
    let margin = |dimension: &f64| (dimension - 5.0).min(7.0 - dimension);
    dimensions.iter().map(margin).collect()
}

fn probed(
    data: &RoomData<'_>,
    features: &str,
    given: &Reproduction<'_>,
) -> Result<ProbeRecord, Error> {
    let room = data.room;
    let rows = data.features.rows();

    let what = || {
        format!(
            "room '{}', features '{}'",
            room.id(),
            data.features.source().name
        )
    };

    let short = MutualKnn {
        frames: MutualKnn::default().frames.min(room.frame_count()),
        ..MutualKnn::default()
    };
    let long = MutualKnn::spanning(room.frame_count());
    let by_twist = MutualKnn {
        pose_distance: PoseDistance::Twist,
        ..long
    };
    let m1 = |options: &MutualKnn| mutual_knn(rows, room.poses(), options).within(what);

    // M2 without a temporal gap, as in the paper; `sweep layers` uses a gap by default.
    let dimension = intrinsic_dimension(rows, 0).within(what)?;
    let ridge = FoldedMotions::of(&Split::FOLDS, |split| {
        Ok(vec![ridge_probe(rows, room, split, given.options.stride)?])
    })
    .within(what)?;

    Ok(ProbeRecord {
        features: features.to_owned(),
        room: room.id().to_string(),
        m1_short: m1(&short)?,
        m1_long: m1(&long)?,
        m1_long_twist: m1(&by_twist)?,
        twonn: dimension.two_nn.linear,
        mle: dimension.mle_biased.harmonic,
        m3: ridge.scores().overall,
        constant: ridge.constant_r2(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand.
    #[test]
    fn dimensions_are_near_six_between_five_and_seven() {
        assert_eq!(margin_around_six(&[4.0, 6.5, 9.0]), [-1.0, 0.5, -2.0]);
    }
}
