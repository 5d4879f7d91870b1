//! Content hashes of a room and an adapter, which identify what tracking states are based on.

use ndarray::{ArrayView2, s};
use sha2::{Digest, Sha256};

use seese3_core::adapter::{Adapter, ErrorStatistics, Network};
use seese3_core::navigation::Navigator;
use seese3_core::room::Room;

/// Content hashes of a room and an adapter. Names and revisions are not sufficient: two stores may
/// use the same ones for different content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Content {
    /// SHA-256 of the adapter and its calibration.
    pub adapter: [u8; 32],
    /// SHA-256 of all frames, as [`frames_content`].
    pub frames: [u8; 32],
}

impl Content {
    /// Computes the hashes for a room with an adapter.
    pub fn of(navigator: &Navigator) -> Self {
        Self {
            adapter: adapter_content(navigator.adapter()),
            frames: frames_content(
                navigator.room(),
                Some(navigator.latents()),
                navigator.room().frame_count(),
            ),
        }
    }
}

/// SHA-256 of the poses and, if given, the latents of a room's first `frame_count` frames. The room
/// must have at least that many.
///
/// Rotations are rounded to 1e-6: extending a room republishes its frames and projects their
/// rotations onto SO(3) again, which may change the last digits.
pub fn frames_content(
    room: &Room,
    latents: Option<ArrayView2<'_, f64>>,
    frame_count: usize,
) -> [u8; 32] {
    let mut digest = ContentDigest(Sha256::new());

    for pose in &room.poses()[..frame_count] {
        digest.numbers(&pose.translation.vector);
        let rotation = pose.rotation.to_rotation_matrix();
        for entry in rotation.matrix() {
            let millionths = (entry * 1e6).round() as i64;
            digest.0.update(millionths.to_le_bytes());
        }
    }
    if let Some(latents) = latents {
        digest.numbers(latents.slice(s![..frame_count, ..]));
    }

    digest.0.finalize().into()
}

fn adapter_content(adapter: &Adapter) -> [u8; 32] {
    let mut digest = ContentDigest(Sha256::new());
    digest.adapter(adapter);
    if let Some(error_model) = adapter.error_model() {
        digest.error_statistics(error_model.statistics());
    }

    digest.0.finalize().into()
}

/// Incremental hash of numbers, in a fixed order.
struct ContentDigest(Sha256);

impl ContentDigest {
    fn numbers<'a>(&mut self, numbers: impl IntoIterator<Item = &'a f64>) {
        for number in numbers {
            self.0.update(number.to_le_bytes());
        }
    }

    fn adapter(&mut self, adapter: &Adapter) {
        for parameter in adapter.network().parameters() {
            self.numbers(&parameter.mapv(f64::from));
        }
        self.numbers(&adapter.scale().mean);
        self.numbers(&adapter.scale().deviation);
    }

    fn error_statistics(&mut self, statistics: &ErrorStatistics) {
        // Destructured with no `..`, so that a new statistic breaks the build here.
        let ErrorStatistics {
            frame_period_s,
            frame_noise,
            match_errors,
            out_of_distribution_ratio,
            certain_match_ratio,
        } = statistics;

        self.numbers(frame_noise);
        for stratum in match_errors.strata() {
            self.numbers([&stratum.at]);
            self.numbers(&stratum.covariance);
        }
        self.numbers([
            out_of_distribution_ratio,
            certain_match_ratio,
            frame_period_s,
        ]);
    }
}
