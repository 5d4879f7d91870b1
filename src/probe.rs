//! `seese3 probe`: how much SE(3) structure features carry, metrics M1 to M4 of the paper.

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use rayon::prelude::*;

use super::output::say;
use super::progress::bar;
use super::protocol::ProtocolOptions;
use super::rooms::{data, load_rooms, room_words};
use super::store_option::StoreAndJson;
use super::with_causes;
use crate::table_files::TableFiles;
use seese3_core::features::Features;
use seese3_core::motion_scores::MotionScores;
use seese3_core::training::{RoomData, TrainingPlan};
use seese3_lab::experiments::probe::{
    DimensionProtocol, DimensionScore, ProbeProtocol, ProbeScores, probe, probe_adapters,
};
use seese3_lab::probes::{Counted, Limit, MutualKnn, PoseDistance};
use seese3_lab::report::{ProbeJson, ProbedRooms, probe_plot, probe_table};
use seese3_store::StoredRoom;

// M1 to M4 are the paper's, so M4 trains as the paper does, also in `sweep layers`.
#[derive(Debug, Args)]
#[command(mut_arg("preset", |preset| preset.default_value("paper-base")))]
pub struct Probe {
    #[command(flatten)]
    common: StoreAndJson,
    #[command(flatten)]
    files: TableFiles,
    /// Rooms to probe: names, or patterns with *; may be given several times
    #[arg(long = "room", required = true)]
    rooms: Vec<String>,
    /// Name of the feature set, the same for every room; may be omitted when the first room has
    /// only one
    #[arg(long)]
    features: Option<String>,
    /// Metrics to compute, separated by commas; all if omitted
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [MetricName::M1, MetricName::M2, MetricName::M3, MetricName::M4])]
    metrics: Vec<MetricName>,
    /// Strides of M3 and M4, separated by commas, instead of --stride; the first one is the
    /// headline
    #[arg(long = "sweep-strides", value_delimiter = ',')]
    sweep: Vec<u32>,
    /// Number of adapters that M4 trains per stride, with seeds 0, 1, …; 1 to 1000
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1_000))]
    seeds: u64,
    /// For M4, also train one adapter on all rooms together, in addition to one per room
    #[arg(long)]
    pooled: bool,
    #[command(flatten)]
    protocol: ProtocolOptions,
    /// M1: number of frames compared
    #[arg(long, default_value_t = 256)]
    m1_frames: usize,
    /// M1: step between compared frames, in frames of the room
    #[arg(long, default_value_t = 1)]
    m1_stride: usize,
    /// M1: number of nearest neighbors, k
    #[arg(long, default_value_t = 10)]
    m1_k: usize,
    /// M1: frames within this temporal distance do not count as neighbors
    #[arg(long, default_value_t = 10)]
    m1_exclusion: usize,
    /// M1: the unit of --m1-exclusion
    #[arg(long, value_enum, default_value_t = CountedName::Sampled)]
    m1_counts: CountedName,
    /// M1: count a frame at exactly the distance --m1-exclusion as a neighbor
    #[arg(long)]
    m1_exclusive: bool,
    /// M1: the distance between poses
    #[arg(long, value_enum, default_value_t = PoseName::NineNumbers)]
    m1_pose: PoseName,
    /// M2: frames to each side that do not count as neighbors. 0 measures the dimension of the
    /// camera path rather than that of the room
    #[arg(long, default_value_t = 10)]
    m2_gap: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum PoseName {
    /// Position and two columns of the rotation matrix, as in the paper
    NineNumbers,
    /// Norm of the twist from one pose to the other, meters and radians mixed
    Twist,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MetricName {
    /// Mutual k-NN: whether neighbors by feature are neighbors by pose
    M1,
    /// Intrinsic dimension of the features, by TwoNN and MLE
    M2,
    /// Ridge probe: test R² of a linear map from feature differences to motions
    M3,
    /// Trained adapter: test R² of its motions
    M4,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum CountedName {
    /// Compared frames, that is, every --m1-stride-th frame
    Sampled,
    /// Frames of the room
    Native,
}

type Loaded = (StoredRoom, Features);

/// Prints the conditions of M2, and which R² are undefined.
fn say_conditions(scores: &[ProbeScores]) {
    // M2 depends on the gap and on how duplicates were treated, so these are printed with it.
    for score in scores {
        let Some(DimensionScore {
            dimension,
            protocol,
        }) = &score.m2
        else {
            continue;
        };

        say(format_args!(
            "M2 of {}: {} rows used, {} copies of them left out, gap {}",
            score.room, dimension.used, dimension.dropped, protocol.gap
        ));
    }

    // R² of a component that is constant over the test pairs would divide by a variance of
    // zero.
    let still = scores
        .iter()
        .flat_map(|score| score.m3.iter().chain(&score.m4))
        .flat_map(|at| &at.runs);

    if still
        .map(MotionScores::still_components)
        .any(|count| count > 0)
    {
        say(
            "some components of the motion never vary; they have no R² and are left out of the means",
        );
    }
}

impl Probe {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open()?;
        self.files.begin()?;
        let rooms = load_rooms(&store, &self.rooms, self.features.as_deref()).await?;

        // M3 and M4 are scored on test pairs; M1 and M2 need no split.
        if self.metrics.contains(&MetricName::M3) || self.metrics.contains(&MetricName::M4) {
            self.protocol.needs_test_pairs()?;
        }

        // Seed 0 is a placeholder: `probe_adapters` sets the seed of each run.
        let plans = self.plans()?;
        let base = &plans[0];
        let pooled = self.pooled && self.metrics.contains(&MetricName::M4);
        let progress = bar((rooms.len() + usize::from(pooled)) as u64, "probing");
        let protocol = self.probe_protocol(&plans);
        let (mut scores, skipped) = probed(&rooms, &protocol, &progress)?;

        // One more row: a single adapter trained on all rooms, its test scores averaged over the
        // rooms.
        if pooled {
            let room_data: Vec<RoomData<'_>> = rooms.iter().map(data).collect();
            let m4 = probe_adapters(&room_data, &protocol)?;
            let room = format!("{} together", room_words(&rooms));

            scores.push(ProbeScores {
                room,
                m1: None,
                m2: None,
                m3: Vec::new(),
                m4,
            });
        }

        progress.finish_and_clear();

        say(format_args!(
            "{}, features '{}'; M3, M4: split {}; M4: {}, {} seeds",
            room_words(&rooms),
            rooms[0].1.source().name,
            self.protocol.split_name(),
            base.preset.name(),
            self.seeds
        ));

        self.files.say_and_draw(
            &probe_table(&scores),
            &probe_plot(&scores),
            &format!("features {}", rooms[0].1.source().name),
        )?;
        skipped
            .iter()
            .for_each(|why| say(format_args!("skipped: {why}")));

        say_conditions(&scores);

        self.common.json.write(&ProbeJson {
            rooms: ProbedRooms::of(&scores),
            features: &rooms[0].1.source().name,
            split: self.protocol.split_name(),
            preset: base.preset.name(),
            skipped,
        })
    }

    /// One training plan per stride: those of --sweep-strides, else the one of --stride. The probes
    /// replace the splits.
    fn plans(&self) -> anyhow::Result<Vec<TrainingPlan>> {
        let first = |protocol: &ProtocolOptions| {
            let plans = protocol.plans(0)?;
            plans.into_iter().next().context("no split was given")
        };

        match self.sweep.as_slice() {
            [] => Ok(vec![first(&self.protocol)?]),
            strides => strides
                .iter()
                .map(|&stride| first(&self.protocol.at_stride(stride)))
                .collect(),
        }
    }

    /// The requested metrics, at every stride of `plans`.
    fn probe_protocol(&self, plans: &[TrainingPlan]) -> ProbeProtocol {
        let wants = |metric: MetricName| self.metrics.contains(&metric);
        let plans_for = |metric: MetricName| {
            if wants(metric) {
                plans.to_vec()
            } else {
                Vec::new()
            }
        };

        let mutual_knn = MutualKnn {
            frames: self.m1_frames,
            stride: self.m1_stride,
            k: self.m1_k,
            exclusion: self.m1_exclusion,
            counted: match self.m1_counts {
                CountedName::Sampled => Counted::Sampled,
                CountedName::Native => Counted::Native,
            },
            limit: if self.m1_exclusive {
                Limit::Exclusive
            } else {
                Limit::Inclusive
            },
            pose_distance: match self.m1_pose {
                PoseName::NineNumbers => PoseDistance::NineNumbers,
                PoseName::Twist => PoseDistance::Twist,
            },
        };
        let dimension = DimensionProtocol { gap: self.m2_gap };

        ProbeProtocol {
            m1: wants(MetricName::M1).then_some(mutual_knn),
            m2: wants(MetricName::M2).then_some(dimension),
            m3: plans_for(MetricName::M3),
            m4: plans_for(MetricName::M4),
            splits: self.protocol.splits(),
            seeds: self.seeds,
        }
    }
}

/// The scores of every room that can be probed, and one line per skipped room with the reason. A
/// single room that cannot be probed is an error.
fn probed(
    rooms: &[Loaded],
    protocol: &ProbeProtocol,
    progress: &indicatif::ProgressBar,
) -> anyhow::Result<(Vec<ProbeScores>, Vec<String>)> {
    let one = |room: &Loaded| {
        let what = || {
            format!(
                "room '{}', features '{}'",
                room.0.room.id(),
                room.1.source().name
            )
        };

        let scores = probe(&data(room), protocol).with_context(what);
        progress.inc(1);

        scores
    };

    // Rooms are probed in parallel; collecting keeps their order.
    let probed: Vec<anyhow::Result<ProbeScores>> = rooms.par_iter().map(one).collect();
    let mut scores = Vec::with_capacity(probed.len());
    let mut skipped = Vec::new();

    // Among several rooms, one that cannot be probed is skipped with its reason.
    for result in probed {
        match result {
            Ok(found) => scores.push(found),
            Err(error) if rooms.len() > 1 => skipped.push(with_causes(&error)),
            Err(error) => return Err(error),
        }
    }

    if let (true, Some(first)) = (scores.is_empty(), skipped.first()) {
        bail!("no room could be probed; the first error: {first}");
    }

    Ok((scores, skipped))
}
