//! The identity of what answers are computed from.

use sha2::{Digest, Sha256};

use seese3_core::adapter::{Adapter, ErrorStatistics, Network};
use seese3_core::fitting::{PartRule, ReadingRule, RoomReader};
use seese3_core::navigation::Navigator;

/// SHA-256 of the numbers that answers are computed from. Name and revision do not identify a room
/// or adapter across stores: two stores may use the same ones for different content.
pub fn content(navigator: &Navigator, reader: Option<&RoomReader>) -> [u8; 32] {
    let mut digest = ContentDigest(Sha256::new());

    // Every number enters with all its bits, so that states resume only where the tracker would
    // compute exactly the same.
    for pose in navigator.room().poses() {
        digest.numbers(&pose.translation.vector);
        digest.numbers(&pose.rotation.coords);
    }
    digest.numbers(navigator.latents());

    let adapter = navigator.adapter();
    digest.adapter(adapter);

    if let Some(reader) = reader {
        for adapter in reader.localizer.adapters() {
            digest.adapter(adapter);
        }
        for rule in reader.rules.rules() {
            digest.reading_rule(rule);
        }
    }

    if let Some(error_model) = adapter.error_model() {
        digest.error_statistics(error_model.statistics());
    }

    digest.0.finalize().into()
}

/// A hash of numbers, in a fixed order.
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

    fn reading_rule(&mut self, rule: &ReadingRule) {
        // Destructured with no `..`, so that a new field breaks the build here.
        let ReadingRule {
            up_to,
            translation,
            rotation,
            covariance,
            least_disagreement,
        } = rule;

        self.numbers([up_to, least_disagreement]);
        self.numbers(covariance);
        for PartRule { reader, gain } in [translation, rotation] {
            self.0.update(reader.name());
            self.numbers([gain]);
        }
    }

    fn error_statistics(&mut self, statistics: &ErrorStatistics) {
        // Destructured with no `..`, so that a new statistic breaks the build here.
        let ErrorStatistics {
            frame_period_s,
            frame_noise,
            motion_spread,
            motion_errors,
            anchor_errors,
            out_of_distribution_ratio,
            certain_match_ratio,
            jump_distance,
            map_pose_factor,
        } = statistics;

        self.numbers(frame_noise);
        self.numbers(motion_spread);
        for table in [&motion_errors.shapes, anchor_errors] {
            for stratum in table.strata() {
                self.numbers([&stratum.at, &stratum.gain]);
                self.numbers(&stratum.covariance);
            }
        }
        self.numbers([
            &motion_errors.floor,
            out_of_distribution_ratio,
            certain_match_ratio,
            jump_distance,
            map_pose_factor,
            frame_period_s,
        ]);
    }
}
