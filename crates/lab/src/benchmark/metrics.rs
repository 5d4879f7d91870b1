//! Metrics M1 to M4 of one feature set in the rooms of a benchmark, by one fixed protocol, so that
//! the files of different encoders can be compared.

use std::collections::BTreeMap;

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};

use seese3_core::adapter::Preset;
use seese3_core::features::FeatureSource;
use seese3_core::splits::Split;
use seese3_core::statistics::{RoomMean, bootstrap_mean, paired_difference};
use seese3_core::training::{RoomData, TrainingPlan};

use super::{
    Benchmark, Error, check_benchmark, check_description, check_format, from_json,
    without_duplicates,
};
use crate::experiments;
use crate::experiments::cross_room::clipped_r2;
use crate::experiments::probe::{DimensionProtocol, ProbeProtocol, probe};
use crate::probes::MutualKnn;

/// The format of a file of metrics.
const METRICS_FORMAT: &str = "seese3 feature metrics 1";
/// Number of adapters of M4 per room and fold, with seeds from 0.
const SEEDS: u64 = 3;
/// Largest size of a metric: larger numbers are mistakes, and would overflow the means.
const MOST: f64 = 1e6;

/// M1 to M4 of a feature set in every room of a benchmark: the content of a file of metrics.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureMetrics {
    format: String,
    /// SHA-256 of the benchmark.
    pub benchmark: String,
    /// The name of the features in the table.
    pub name: String,
    /// One sentence: the encoder, its weights, the layer and the pooling.
    pub about: String,
    /// Where the encoder is described; optional.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub url: Option<String>,
    /// How the features were made.
    pub source: FeatureSource,
    /// The metrics, by room.
    #[serde(deserialize_with = "without_duplicates")]
    pub rooms: BTreeMap<String, RoomMetrics>,
    #[serde(default, skip_serializing)]
    made_by: IgnoredAny,
}

/// M1 to M4 in one room.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoomMetrics {
    /// M1: share of the nearest neighbors by feature that are nearest by pose, 0 to 1.
    pub m1: f64,
    /// M2 by TwoNN.
    pub m2_twonn: f64,
    /// M2 by maximum likelihood.
    pub m2_mle: f64,
    /// M3: test R² of ridge regression.
    pub m3: f64,
    /// M4: test R² of adapters, mean over seeds.
    pub m4: f64,
    /// Test R² of always answering the mean training motion.
    pub constant: f64,
}

impl RoomMetrics {
    /// Measures the features of a room. `stride` is that of the benchmark, in frames.
    ///
    /// M1: at most 256 frames at the smallest stride that spans the recording, k 10, 10 of them to
    /// each side left out. M2: without a gap. M3 and M4: five folds, whose test pairs are scored
    /// together; M4: preset `base`, seeds 0 to 2.
    ///
    /// # Errors
    /// [`experiments::Error`] with the name of the failed metric; a metric that is undefined.
    pub fn measure(data: &RoomData<'_>, stride: u32) -> Result<Self, experiments::Error> {
        // The splits of the plans are replaced by those of the protocol.
        let plan = TrainingPlan::of(Preset::Base, Split::Whole, stride, 0);
        let scores = probe(
            data,
            &ProbeProtocol {
                m1: Some(MutualKnn::spanning(data.room.frame_count())),
                m2: Some(DimensionProtocol { gap: 0 }),
                m3: vec![plan.clone()],
                m4: vec![plan],
                splits: Split::FOLDS.to_vec(),
                seeds: SEEDS,
            },
        )?;

        let (Some(m1), Some(m2)) = (scores.m1, scores.m2) else {
            return Err(undefined("m1 or m2"));
        };
        let (Some(ridge), Some(adapter)) = (scores.m3.first(), scores.m4.first()) else {
            return Err(undefined("m3 or m4"));
        };

        let constant = ridge.baselines.ok_or_else(|| undefined("constant"))?;
        let metrics = Self {
            m1: m1.share,
            m2_twonn: m2.dimension.two_nn.linear,
            m2_mle: m2.dimension.mle_biased.harmonic,
            m3: ridge.r2,
            m4: adapter.r2,
            constant: constant.constant_r2,
        };

        match metrics.not_finite() {
            Some(name) => Err(undefined(name)),
            None => Ok(metrics),
        }
    }

    /// The metrics with their keys.
    fn named(&self) -> [(&'static str, f64); 6] {
        [
            ("m1", self.m1),
            ("m2_twonn", self.m2_twonn),
            ("m2_mle", self.m2_mle),
            ("m3", self.m3),
            ("m4", self.m4),
            ("constant", self.constant),
        ]
    }

    fn not_finite(&self) -> Option<&'static str> {
        let found = self
            .named()
            .into_iter()
            .find(|(_, value)| !value.is_finite());
        found.map(|(name, _)| name)
    }
}

fn undefined(metric: &str) -> experiments::Error {
    experiments::Error::Input(format!(
        "{metric} is undefined: all features or all motions of the room are equal"
    ))
}

/// The texts and the features of a file of metrics.
pub struct Described<'a> {
    /// As [`FeatureMetrics::name`].
    pub name: &'a str,
    /// As [`FeatureMetrics::about`].
    pub about: &'a str,
    /// As [`FeatureMetrics::source`].
    pub source: FeatureSource,
}

impl FeatureMetrics {
    /// The metrics of the rooms of a benchmark, in its order.
    pub fn new(benchmark: &Benchmark, features: Described<'_>, rooms: Vec<RoomMetrics>) -> Self {
        let names = benchmark.rooms.iter().map(|room| room.room.clone());
        Self {
            format: METRICS_FORMAT.to_owned(),
            benchmark: benchmark.sha256(),
            name: features.name.to_owned(),
            about: features.about.to_owned(),
            url: None,
            source: features.source,
            rooms: names.zip(rooms).collect(),
            made_by: IgnoredAny,
        }
    }

    /// Reads the content of a file, and checks it against the benchmark.
    ///
    /// # Errors
    /// [`Error`] names the first field that is wrong.
    pub fn read(bytes: &[u8], benchmark: &Benchmark) -> Result<Self, Error> {
        let metrics: Self = from_json(bytes, "metrics")?;
        metrics.check(benchmark)?;
        Ok(metrics)
    }

    /// Checks the metrics against the benchmark.
    ///
    /// # Errors
    /// [`Error`] names the first field that is wrong.
    pub fn check(&self, benchmark: &Benchmark) -> Result<(), Error> {
        check_format(&self.format, METRICS_FORMAT)?;
        check_benchmark(&self.benchmark, benchmark)?;
        check_description(&self.name, &self.about, self.url.as_deref())?;

        let place = |room: &str| format!("rooms.{room}");
        let known = |name: &String| benchmark.rooms.iter().any(|room| room.room == *name);
        if let Some(other) = self.rooms.keys().find(|name| !known(name)) {
            return Err(Error::new(place(other), "is no room of the benchmark"));
        }

        for room in &benchmark.rooms {
            let Some(metrics) = self.rooms.get(&room.room) else {
                return Err(Error::new(place(&room.room), "is missing"));
            };

            // M1 is a share, M2 a dimension; the others are R².
            for (name, value) in metrics.named() {
                let (range, words) = match name {
                    "m1" => (0.0..=1.0, "from 0 to 1"),
                    "m2_twonn" | "m2_mle" => (0.0..=MOST, "from 0 to 1000000"),
                    _ => (-MOST..=1.0, "an R² from -1000000 to 1"),
                };
                if !range.contains(&value) {
                    let place = format!("{}.{name}", place(&room.room));
                    return Err(Error::new(place, format!("must be {words}")));
                }
            }
        }

        if self.source.dim == 0 {
            return Err(Error::new("source.dim", "must be at least 1"));
        }
        Ok(())
    }
}

/// Means over the rooms of a benchmark, with 95 % intervals of resampled rooms. Every R² counts as
/// max(R², −1): otherwise one room could decide the mean.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MetricMeans {
    /// The name of the features.
    pub name: String,
    /// The `about` text of the file.
    pub about: String,
    /// Where the encoder is described.
    pub url: Option<String>,
    /// The number of columns of a feature.
    pub columns: usize,
    /// M1.
    pub m1: RoomMean,
    /// M2 by TwoNN.
    pub m2_twonn: RoomMean,
    /// M2 by maximum likelihood.
    pub m2_mle: RoomMean,
    /// M3.
    pub m3: RoomMean,
    /// M4.
    pub m4: RoomMean,
    /// M4 minus the R² of the mean training motion, paired by room.
    pub m4_over_constant: RoomMean,
}

impl MetricMeans {
    /// The means of checked metrics.
    pub fn of(metrics: &FeatureMetrics) -> Self {
        let values =
            |of: fn(&RoomMetrics) -> f64| -> Vec<f64> { metrics.rooms.values().map(of).collect() };
        let over_rooms = |of| bootstrap_mean(&values(of), 0);
        let adapter = values(|room| clipped_r2(room.m4));
        let constant = values(|room| clipped_r2(room.constant));

        Self {
            name: metrics.name.clone(),
            about: metrics.about.clone(),
            url: metrics.url.clone(),
            columns: metrics.source.dim,
            m1: over_rooms(|room| room.m1),
            m2_twonn: over_rooms(|room| room.m2_twonn),
            m2_mle: over_rooms(|room| room.m2_mle),
            m3: over_rooms(|room| clipped_r2(room.m3)),
            m4: bootstrap_mean(&adapter, 0),
            m4_over_constant: paired_difference(&adapter, &constant, 0),
        }
    }
}
