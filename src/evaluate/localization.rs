//! `seese3 evaluate localization`: maps a part of a room and localizes the views of the other part.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, bail};
use clap::Args;

use seese3_core::eval::has_seen;
use seese3_core::features::Features;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::room::{FrameId, Room};
use seese3_core::splits::HoldOut;
use seese3_core::training::RoomData;
use seese3_lab::experiments::check_hold_out;
use seese3_lab::experiments::localization::{LocalizationProtocol, RuleScores, evaluate};
use seese3_lab::experiments::matched_localization::{
    self, MappedAndAsked, MatchedLocalization, PeerAnswer, PosedRecording,
};
use seese3_lab::report::{
    LocalizationContext, LocalizationJson, estimate_errors_file, localization_table,
    matched_localization_table,
};

use super::super::fit::fitting_bar;
use super::super::named::one_of;
use super::super::output::{JsonOutput, say};
use super::super::progress::bar;
use super::keypoint_views::KeypointViews;
use super::peer::{Peer, PeerTask};
use super::room_images::RoomImages;
use crate::errors_file::ErrorsFile;
use crate::table_files::TableFiles;
use seese3_store::{Store, StoredRoom};

/// Width of images that are drawn for the peer, pixels.
const PEER_WIDTH: usize = 640;

#[derive(Debug, Args)]
pub struct Localization {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Pre-trained adapter of other rooms: evaluated zero-shot and, with --fit, the initial weights
    /// of the fitted adapter. Without --adapter and --fit, matched views are evaluated, which need
    /// a room with keypoints
    #[arg(long)]
    adapter: Option<String>,
    /// Name of the feature set of the adapter; by default the one it was trained on
    #[arg(long)]
    features: Option<String>,
    /// Also fit an adapter to the mapped frames only, with rules that are measured on them
    #[arg(long)]
    fit: bool,
    /// Map one frame in this many; the views of the others are localized; 1 to 100000
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    map_every: u32,
    /// Divide the recording into 20 blocks, leave every fifth block unmapped, and localize only the
    /// views of these blocks
    #[arg(long)]
    map_blocks: bool,
    /// Choose the mapped frames by a hold-out instead of --map-every; matched views only
    #[arg(long, value_parser = one_of::<HoldOut>(), conflicts_with_all = ["map_every", "map_blocks", "adapter", "fit"])]
    hold_out: Option<HoldOut>,
    /// Also locate the views by a peer: SIFT features, VLAD, triangulated points and PoseLib's
    /// absolute pose. PYTHON is an interpreter with numpy, opencv-python-headless and poselib
    #[arg(long, value_name = "PYTHON", conflicts_with_all = ["adapter", "fit"])]
    peer: Option<PathBuf>,
    /// The peer locates one view in this many; the comparison is on these views; 1 to 100000
    #[arg(long, value_name = "N", default_value_t = 1, requires = "peer", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    peer_every: u32,
    /// Seed of the fitted adapter, 0 to 2³² − 1
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=u64::from(u32::MAX)))]
    seed: u64,
    #[command(flatten)]
    views: KeypointViews,
    #[command(flatten)]
    files: TableFiles,
    #[command(flatten)]
    errors: ErrorsFile,
    #[command(flatten)]
    json: JsonOutput,
}

impl Localization {
    pub async fn run(self) -> anyhow::Result<()> {
        self.json.begin()?;
        self.files.begin()?;
        self.errors.begin()?;
        let store = Store::open(&self.store)?;
        if self.adapter.is_none() && !self.fit {
            if self.features.is_some() {
                bail!("--features needs --adapter or --fit: matched views use keypoints");
            }
            return self.evaluate_matched(&store).await;
        }

        self.views.refuse_images()?;
        let stored_adapter = match &self.adapter {
            Some(name) => Some(store.load_adapter(name, None).await?),
            None => None,
        };
        let of_adapter = stored_adapter
            .as_ref()
            .map(|stored| stored.adapter.source().name.clone());
        let wanted = self.features.clone().or(of_adapter);
        let (stored, features) = store.load_room_with(&self.room, wanted.as_deref()).await?;

        let is_leak = stored_adapter
            .as_ref()
            .is_some_and(|adapter| has_seen(&adapter.record, stored.room.id()));
        if is_leak {
            say(format_args!(
                "LEAK: the adapter has seen room '{}'",
                self.room
            ));
        }

        let data = RoomData {
            room: &stored.room,
            revision: stored.revision,
            features: &features,
        };
        let protocol = self.protocol();

        let progress = fitting_bar(self.fit);
        let adapter = stored_adapter.as_ref().map(|stored| &stored.adapter);
        let found = evaluate(&data, adapter, self.fit, &protocol, &|_| progress.inc(1))?;
        progress.finish_and_clear();

        self.say_room(&stored, &features, found.mapped, found.asked);
        self.files.say(&localization_table(&found), &self.room)?;

        if let Some(rules) = &found.rules {
            say_rules(rules);
        }

        self.errors
            .write(|| estimate_errors_file(&self.room, &found.views))?;
        self.write(&features, &found)
    }

    /// Evaluates matched views.
    async fn evaluate_matched(&self, store: &Store) -> anyhow::Result<()> {
        let peer = self.peer.as_deref().map(Peer::new).transpose()?;
        let stored = store.load_room(&self.room, None).await?;
        let Some(keypoints) = &stored.keypoints else {
            bail!(
                "room '{}' has no keypoints: encode it with `seese3 encode --recipe xfeat-keypoints`, or give --adapter \
                 or --fit",
                self.room
            );
        };
        let features = stored.features(&keypoints.source.feature.name);
        let features = features.context("the room's keypoints have no features")?;

        let (mapped, asked) = self.frames(&stored)?;
        let encoded = self.views.encode(&stored, keypoints)?;
        let recording = PosedRecording {
            poses: stored.room.poses(),
            keypoints: &encoded.keypoints,
            camera: keypoints.map.camera,
        };

        let frames = MappedAndAsked {
            mapped: &mapped,
            asked: &asked,
            peer: &[],
        };
        let answers = match &peer {
            Some(peer) => self.ask(peer, &stored.room, recording.camera, frames)?,
            None => Vec::new(),
        };
        let frames = MappedAndAsked {
            peer: &answers,
            ..frames
        };

        let progress = bar(asked.len() as u64, "localizing");
        let begun = Instant::now();
        let found = self.views.runtime.pool()?.install(|| {
            let clock = || begun.elapsed().as_secs_f64();
            matched_localization::evaluate(recording, encoded.rows.view(), frames, &clock, &|| {
                progress.inc(1)
            })
        })?;
        progress.finish_and_clear();

        self.say_room(&stored, features, found.mapped, found.all.n);
        let (table, notes) = matched_localization_table(&found);
        self.files.say(&table, &self.room)?;
        say(notes);
        self.errors
            .write(|| estimate_errors_file(&self.room, &found.views))?;
        self.write::<MatchedLocalization>(features, &found)
    }

    /// The peer's answers to every N-th of the asked frames.
    fn ask(
        &self,
        peer: &Peer<'_>,
        room: &Room,
        camera: CameraIntrinsics,
        frames: MappedAndAsked<'_>,
    ) -> anyhow::Result<Vec<PeerAnswer>> {
        let height = (PEER_WIDTH as f64 * camera.height()).round() as usize;
        let images = RoomImages::of(room, self.views.images.as_deref(), (PEER_WIDTH, height))?;
        let queries: Vec<FrameId> = frames
            .asked
            .iter()
            .copied()
            .step_by(self.peer_every as usize)
            .collect();
        let task = PeerTask {
            poses: room.poses(),
            images: &images,
            camera,
            mapped: frames.mapped,
            queries: &queries,
        };

        let progress = bar(queries.len() as u64, "localizing by the peer");
        let answers = peer.locate(&task, &|| progress.inc(1))?;
        progress.finish_and_clear();
        Ok(answers)
    }

    /// The mapped frames, and the frames that are asked for.
    fn frames(&self, stored: &StoredRoom) -> anyhow::Result<(Vec<FrameId>, Vec<FrameId>)> {
        let timeline = stored.room.timeline();
        match self.hold_out {
            Some(hold_out) => {
                check_hold_out(&stored.room, hold_out)?;
                Ok((hold_out.mapped(timeline), hold_out.tracked(timeline)))
            }
            None => {
                let protocol = self.protocol();
                let count = timeline.frame_count;
                Ok((protocol.mapped(count), protocol.asked(count)))
            }
        }
    }

    fn protocol(&self) -> LocalizationProtocol {
        LocalizationProtocol {
            map_every: self.map_every as usize,
            withhold_blocks: self.map_blocks,
            seed: self.seed,
        }
    }

    fn say_room(&self, stored: &StoredRoom, features: &Features, mapped: usize, asked: usize) {
        say(format_args!(
            "room '{}' revision {}, features '{}': {mapped} frames mapped, {asked} views localized",
            self.room,
            stored.revision,
            features.source().name,
        ));
    }

    fn write<T: serde::Serialize>(&self, features: &Features, found: &T) -> anyhow::Result<()> {
        if !self.json.is_wanted() {
            return Ok(());
        }

        let protocol = LocalizationContext {
            room: self.room.clone(),
            features: features.source().name.clone(),
            adapter: self.adapter.clone(),
            hold_out: self.hold_out.map(HoldOut::name),
            map_every: self.map_every as usize,
            map_blocks: self.map_blocks,
            seed: self.seed,
        };
        self.json.write(&LocalizationJson { found, protocol })
    }
}

/// Prints how often the rules used the nearest frame's pose, and the coverage of their covariances.
fn say_rules(rules: &RuleScores) {
    say(format_args!(
        "ours used the nearest frame's translation for {:.0} % of the views and its rotation for {:.0} %; coverage \
         of its covariances: {:.3} at 68 % and {:.3} at 95 %",
        100.0 * rules.translation_unread,
        100.0 * rules.rotation_unread,
        rules.coverage.within_68,
        rules.coverage.within_95
    ));
}
