//! `seese3 encode`: computes features from the images of a stored room.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use clap::Args;
use serde_json::{Value, json};

use super::encoder::{EncoderOptions, RuntimeOptions, feature_prefix, say_features};
use super::keypoints::{check_aspect, map_keypoints, mapping_inputs, room_keypoints};
use super::output::say;
use super::progress::bar;
use super::room_names::room_names;
use super::shard::Shard;
use super::store_option::StoreAndJson;
use seese3_core::cancel::Cancellation;
use seese3_core::features::{FeatureSource, Features};
use seese3_core::geometry::{CameraIntrinsics, Pose};
use seese3_core::room::{Room, is_plain_name};
use seese3_encoder::{
    Encoded, Encoder, Journal, Kept, KeypointOutputs, OnBadImage, Task, encode_room, read_image,
};
use seese3_robot::matched_views::{KeypointMap, MappedKeypoints};
use seese3_store::{Published, RoomContents, RoomKeypoints, Store, StoredRoom};

/// Maximum number of unreadable images that are listed one by one; further ones are only counted.
const NAMED: usize = 20;

#[derive(Debug, Args)]
pub struct Encode {
    #[command(flatten)]
    common: StoreAndJson,
    /// The rooms, imported from recordings with images: names, or patterns with *; may be given
    /// several times. Several rooms are encoded one after the other, and one that fails does not
    /// stop the others
    #[arg(long = "room", value_name = "ROOM", required = true)]
    rooms: Vec<String>,
    /// Encode only shard I of N of the rooms, to distribute them over jobs: 1/4 to 4/4
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// The encoder: an ONNX file, or `pixels` or `builtin`, which need no model file
    #[arg(long = "encoder", value_name = "MODEL")]
    model: String,
    #[command(flatten)]
    encoder: EncoderOptions,
    #[command(flatten)]
    runtime: RuntimeOptions,
    /// Frames per run of the model, 1 to 4096
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=4_096))]
    batch: u32,
    /// Folder that the room's image paths are relative to, if the images were moved since the
    /// import
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Prefix of the feature names, PREFIX-LAYER-POOLING; the model's file name without extension
    /// if omitted
    #[arg(long = "prefix", value_name = "PREFIX")]
    prefix: Option<String>,
    /// Drop frames with an unreadable image, instead of stopping. The room's new revision omits
    /// these frames, in all its features
    #[arg(long)]
    skip_bad: bool,
    /// Encode even if the room already has these features, and discard an unfinished run
    #[arg(long)]
    again: bool,
    /// Folder for the journal, which keeps encoded rows until the room is complete, so that an
    /// interrupted run can resume; STORE/unfinished if omitted, required for a bucket
    #[arg(long, value_name = "DIR")]
    journal: Option<PathBuf>,
}

impl Encode {
    pub async fn run(self) -> anyhow::Result<()> {
        let store = self.common.open_to_publish().await?;
        let runtime = self.runtime.runtime();
        let encoder = self.encoder.open(&self.model, &runtime)?;
        let sources = encoder.sources(&feature_prefix(self.prefix.as_deref(), &self.model));
        check_names(&sources)?;
        // The encoders without a model have no runtime.
        let runtime = match encoder.runtime() {
            name if name == runtime.kind.name() => runtime.to_string(),
            none => none.to_owned(),
        };
        say(format_args!(
            "encoder {} by {runtime}, {}",
            encoder.id(),
            sources[0].preprocess
        ));

        let job = Job {
            store: &store,
            encoder: &encoder,
            sources: &sources,
            runtime,
        };
        match &self.rooms[..] {
            [room] if !room.contains('*') && self.shard.parts == 1 => {
                self.common.json.write(&self.encode_room(&job, room).await?)
            }
            given => {
                let rooms = room_names(&store, given).await?;
                ensure!(
                    self.images.is_none() || rooms.len() == 1,
                    "--images is the folder of one room, but {} rooms are given",
                    rooms.len()
                );
                self.encode_rooms(&job, self.shard.tasks(rooms)).await
            }
        }
    }

    /// Encodes rooms one after the other, and writes the JSON record of all. A room that fails is
    /// listed.
    async fn encode_rooms(&self, job: &Job<'_>, rooms: Vec<String>) -> anyhow::Result<()> {
        let Shard { part, parts } = self.shard;
        say(format_args!(
            "{} rooms to encode here (shard {part} of {parts})",
            rooms.len()
        ));

        let mut records = Vec::new();
        let mut failed = Vec::new();
        for (number, room) in (1..).zip(&rooms) {
            say(format_args!("room '{room}', {number} of {}", rooms.len()));
            match self.encode_room(job, room).await {
                Ok(record) => records.push(record),
                Err(error) => {
                    let problem = format!("{error:#}");
                    say(format_args!("room '{room}' failed: {problem}"));
                    failed.push(json!({ "room": room, "problem": problem }));
                }
            }
        }

        let written = self.common.json.write(&json!({
            "shard": format!("{part}/{parts}"),
            "rooms": records,
            "failed": failed,
        }));
        ensure!(
            failed.is_empty(),
            "{} of {} rooms failed, see above; the same command encodes what is missing",
            failed.len(),
            rooms.len()
        );
        written
    }

    /// Encodes one room and publishes it; the record of the room.
    async fn encode_room(&self, job: &Job<'_>, name: &str) -> anyhow::Result<Value> {
        let Job {
            store,
            encoder,
            sources,
            ..
        } = *job;
        let stored = store.load_room(name, None).await?;

        // The camera and the image folder are checked first, so that a long run does not fail at
        // its end.
        let camera = stored.room.provenance().camera;
        let mapping = mapping_inputs(encoder, camera, name)?;
        let root = images_root(&stored.room, self.images.as_deref())?;

        // Features count as present only if encoder, layer and preprocessing match too. A set with
        // the same name and another source is replaced.
        let has_keypoints = mapping.is_none() || has_keypoints(&stored, &sources[0]);
        if !self.again && has_keypoints && sources.iter().all(|source| has(&stored, source)) {
            let names: Vec<&str> = sources.iter().map(|source| source.name.as_str()).collect();
            let revision = stored.revision;
            say(format_args!(
                "already there in room '{name}' revision {revision}: {}",
                names.join(", ")
            ));

            return Ok(record(name, sources, revision, 0, &[]));
        }

        say_replaced(&stored, sources);
        let (published, encoded) = self.encode_anew(job, &stored, &root, mapping).await?;
        let location = store.location();
        say(format_args!(
            "published room '{name}' revision {}: {location}/{}",
            published.revision, published.manifest
        ));

        let encoded_now = encoded.good.len() - encoded.resumed.min(encoded.good.len());
        Ok(record(
            name,
            sources,
            published.revision,
            encoded_now,
            &encoded.bad,
        ))
    }

    /// Encodes the images below `root` of a room, and publishes the features.
    async fn encode_anew(
        &self,
        job: &Job<'_>,
        stored: &StoredRoom,
        root: &Path,
        mapping: Option<(&KeypointOutputs, CameraIntrinsics)>,
    ) -> anyhow::Result<(Published, Encoded)> {
        let Job { store, sources, .. } = *job;
        let name = stored.room.id().as_str();

        // The journal keeps the rows of an interrupted run. Its key covers all inputs of the
        // encoding, so that rows of another model or of changed images are never mixed in.
        let key = key(stored, job, root);
        let path = self.journal_path(name, &key)?;
        if self.again && path.exists() {
            std::fs::remove_file(&path).with_context(|| path.display().to_string())?;
        }

        // Opening locks the journal, so that two processes cannot encode the same room into it at
        // once.
        let (mut journal, before) = Journal::open(&path, &key)?;
        let begun = Instant::now();

        let encoded = self.encode(
            &stored.room,
            root,
            job.encoder,
            Kept {
                journal: &mut journal,
                before,
            },
        )?;

        let seconds = begun.elapsed().as_secs_f64();
        say_bad(&stored.room, &encoded);

        if encoded.good.is_empty() {
            bail!(seese3_encoder::Error::AllBad {
                room: name.to_owned()
            });
        }

        // Another process may have published the room in the meantime. The rows belong to the
        // encoded frames, so these must not have changed.
        let newest = store.load_room(name, None).await?;
        if !same_poses(&newest.room, &stored.room) {
            bail!(
                "the frames of room '{name}' changed during encoding (revision {}, was {}); run the command again",
                newest.revision,
                stored.revision
            );
        }

        let keypoints = match mapping {
            Some((outputs, camera)) => {
                let map = self.map(&newest.room, &encoded, camera)?;
                Some(room_keypoints(
                    map,
                    sources[0].clone(),
                    outputs,
                    &self.model,
                )?)
            }
            None => None,
        };
        let published = publish(store, newest, sources, &encoded, keypoints.as_ref()).await?;

        // The rows are safe in the store, so the journal is no longer needed.
        journal.finish()?;

        say_encoded(&encoded, sources, seconds);
        if let Some(keypoints) = &keypoints {
            say_keypoints(&keypoints.map);
        }
        Ok((published, encoded))
    }

    /// Triangulates the keypoints of the encoded frames.
    fn map(
        &self,
        room: &Room,
        encoded: &Encoded,
        camera: CameraIntrinsics,
    ) -> anyhow::Result<KeypointMap> {
        let poses = room.frames().select(&encoded.good).poses;
        let pool = self.runtime.pool()?;
        pool.install(|| map_keypoints(&poses, &encoded.keypoints, camera))
    }

    fn journal_path(&self, room: &str, key: &str) -> anyhow::Result<PathBuf> {
        let folder = match &self.journal {
            Some(folder) => folder.clone(),
            None if self.common.store.contains("://") => {
                bail!("--journal DIR is required for a store in a bucket")
            }
            None => Path::new(&self.common.store).join("unfinished"),
        };

        // Another encoder, room revision or image folder gives another key, and hence a separate
        // journal.
        Ok(folder.join(format!("{room}-{}.rows", seese3_store::short_digest(key))))
    }

    fn encode(
        &self,
        room: &Room,
        root: &Path,
        encoder: &Encoder,
        kept: Kept<'_>,
    ) -> anyhow::Result<Encoded> {
        let images = room.images();
        let keypoint_camera = encoder
            .keypoint_outputs()
            .and(room.provenance().camera.as_ref());
        let image = |row: usize| {
            let image = read_image(root, &images[row])?;
            check_aspect(image, &images[row], keypoint_camera)
        };
        let cancel = Cancellation::default();

        let on_bad = if self.skip_bad {
            OnBadImage::Skip
        } else {
            OnBadImage::Stop
        };

        let task = Task {
            timeline: room.timeline(),
            image: &image,
            batch: self.batch as usize,
            on_bad,
            cancel: &cancel,
        };

        let progress = bar(room.frame_count() as u64, "encoding");

        // Decoding, encoding and tract all run on this pool, so that --threads limits them
        // together.
        let pool = self.runtime.pool()?;

        let told = |done: usize| progress.set_position(done as u64);
        let encoded = pool.install(|| encode_room(&task, encoder, Some(kept), &told));
        progress.finish_and_clear();

        encoded.context("the rows encoded so far are kept; run the same command again to resume")
    }
}

/// What encodes the rooms of a run.
struct Job<'a> {
    store: &'a Store,
    encoder: &'a Encoder,
    sources: &'a [FeatureSource],
    /// The runtime and its device, for the journal.
    runtime: String,
}

/// The JSON record of a room.
fn record(
    room: &str,
    sources: &[FeatureSource],
    revision: u64,
    encoded: usize,
    left_out: &[(usize, String)],
) -> Value {
    let features: Vec<_> = sources
        .iter()
        .map(|source| json!({ "name": source.name, "columns": source.dim }))
        .collect();
    let left_out: Vec<_> = left_out
        .iter()
        .map(|(frame, problem)| json!({ "frame": frame, "problem": problem }))
        .collect();

    json!({
        "room": room,
        "revision": revision,
        "features": features,
        "encoded_count": encoded,
        "left_out": left_out,
    })
}

/// Prints which stored features are replaced: those with the same name and a different source.
fn say_replaced(stored: &StoredRoom, sources: &[FeatureSource]) {
    for source in sources
        .iter()
        .filter(|source| stored.features(&source.name).is_some() && !has(stored, source))
    {
        say(format_args!(
            "replaces features '{}', computed with another encoder, layer or preprocessing",
            source.name
        ));
    }
}

/// Whether the room has keypoints of the encoder pass that makes these features, mapped with the
/// room's camera.
pub fn has_keypoints(stored: &StoredRoom, feature: &FeatureSource) -> bool {
    stored.keypoints.as_ref().is_some_and(|keypoints| {
        keypoints.source.feature == *feature
            && Some(keypoints.map.camera) == stored.room.provenance().camera
    })
}

/// Prints how many keypoints were mapped.
fn say_keypoints(map: &KeypointMap) {
    let count: usize = map.frames.iter().map(MappedKeypoints::len).sum();
    say(format_args!(
        "mapped {:.0} keypoints a frame, median depth {:.2} m, epipolar error {:.2} pixels of an image 320 wide; \
         noise of the map: {:.4} m, {:.2} degrees, design effect {:.1}, doubled at a gap of {:.3}",
        count as f64 / map.frames.len() as f64,
        map.unit_m,
        map.epipolar_px,
        map.noise.pose_noise * map.unit_m,
        map.noise.pose_noise.to_degrees(),
        map.noise.design_effect,
        map.noise.gap_scale
    ));
}

/// Prints how many frames were encoded, how fast, and into which features.
fn say_encoded(encoded: &Encoded, sources: &[FeatureSource], seconds: f64) {
    // Resumed rows cost no time in this run and would inflate the rate.
    let fresh = encoded.good.len() - encoded.resumed.min(encoded.good.len());
    let rate = fresh as f64 / seconds;
    say(format_args!(
        "encoded {fresh} frames in {seconds:.1} s ({rate:.0} a second), {} were done before",
        encoded.resumed
    ));

    say_features(sources);
}

/// The folder that the room's image paths start from: `given`, or where the images were at import.
pub(super) fn images_root(room: &Room, given: Option<&Path>) -> anyhow::Result<PathBuf> {
    if room.images().is_empty() {
        bail!(seese3_encoder::Error::NoImages {
            room: room.id().to_string()
        });
    }

    let root = given.map_or_else(
        || PathBuf::from(&room.provenance().images_root),
        Path::to_owned,
    );

    if !root.is_dir() {
        bail!(
            "{} is not a folder; give the folder of the images with --images DIR",
            root.display()
        );
    }

    Ok(root)
}

/// Whether the room has features with this name and exactly this source.
pub fn has(stored: &StoredRoom, source: &FeatureSource) -> bool {
    stored
        .features(&source.name)
        .is_some_and(|set| set.source() == source)
}

/// Journal key. It covers all inputs of the encoding: room, revision, image folder, runtime, images
/// with their sizes and times, sequences, and sources.
fn key(stored: &StoredRoom, job: &Job<'_>, root: &Path) -> String {
    let room = &stored.room;
    let sources = job.encoder.sources("");

    // A file that was rewritten has another size or modification time.
    let state = |image: &String| {
        // An image inside a container is written FILE@OFFSET+LENGTH; the state is that of the
        // container.
        let file = image
            .rsplit_once('@')
            .map_or(image.as_str(), |(file, _)| file);
        let metadata = std::fs::metadata(root.join(file)).ok()?;

        Some((metadata.len(), metadata.modified().ok()))
    };

    let states: Vec<_> = room.images().iter().map(state).collect();
    format!(
        "{}\n{}\n{}\n{}\n{:?}\n{:?}\n{:?}\n{:?}",
        room.id(),
        stored.revision,
        root.display(),
        job.runtime,
        room.images(),
        states,
        room.timeline().sequences,
        sources
    )
}

/// Rejects layers with invalid or duplicate feature names, before anything is encoded.
pub fn check_names(sources: &[FeatureSource]) -> anyhow::Result<()> {
    for (position, FeatureSource { name, layer, .. }) in sources.iter().enumerate() {
        if !is_plain_name(name) {
            bail!(
                "layer '{layer}' gives the feature name '{name}', which is not valid (1 to 100 letters, digits, '.', '-' \
                 and '_', starting with a letter or digit); give --prefix PREFIX"
            );
        }

        if sources[..position].iter().any(|other| other.name == *name) {
            bail!(
                "two layers give the feature name '{name}'; encode them separately, with --prefix PREFIX"
            );
        }
    }

    Ok(())
}

/// Whether two rooms have the same number of frames and the same poses, up to 1e-9 in each entry of
/// the homogeneous matrices.
pub fn same_poses(a: &Room, b: &Room) -> bool {
    let near = |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-9;
    a.frame_count() == b.frame_count() && a.poses().iter().zip(b.poses()).all(near)
}

fn say_bad(room: &Room, encoded: &Encoded) {
    for (row, problem) in encoded.bad.iter().take(NAMED) {
        say(format_args!(
            "left out frame {row} ({}): {problem}",
            room.images()[*row]
        ));
    }

    if !encoded.bad.is_empty() {
        say(format_args!(
            "left out {} frames in all; the room's new revision omits them",
            encoded.bad.len()
        ));
    }
}

/// Splits encoded rows (n, Σ d), the layers concatenated, into one feature set (n, d) per source.
pub fn by_layer(
    sources: &[FeatureSource],
    rows: &ndarray::Array2<f32>,
) -> anyhow::Result<Vec<Features>> {
    let mut from = 0;
    let mut features = Vec::with_capacity(sources.len());
    for source in sources {
        let columns = rows
            .slice(ndarray::s![.., from..from + source.dim])
            .to_owned();
        features.push(Features::new(source.clone(), columns)?);

        from += source.dim;
    }

    Ok(features)
}

/// Publishes the feature rows with their frames. Skipped frames are removed from the room.
async fn publish(
    store: &Store,
    newest: StoredRoom,
    sources: &[FeatureSource],
    encoded: &Encoded,
    keypoints: Option<&RoomKeypoints>,
) -> anyhow::Result<Published> {
    let is_whole = encoded.good.len() == newest.room.frame_count();
    let (room, features) = whole(newest, sources, encoded)?;
    let contents = RoomContents {
        room: &room,
        features: &features,
        keypoints,
    };

    Ok(if is_whole {
        store.publish_contents_of_same_frames(contents).await?
    } else {
        store.publish_contents(contents).await?
    })
}

/// The room and its feature sets for publication. Skipped frames are removed from all of them.
fn whole(
    stored: StoredRoom,
    sources: &[FeatureSource],
    encoded: &Encoded,
) -> anyhow::Result<(Room, Vec<Features>)> {
    let mut features = by_layer(sources, &encoded.rows)?;
    if encoded.bad.is_empty() {
        return Ok((stored.room, features));
    }

    // With other frames, the store carries no features over. The older features are therefore cut
    // to the same frames and published again.
    let frames = stored.room.frames().select(&encoded.good);
    let provenance = stored.room.provenance().clone();
    let room = Room::new(stored.room.id().clone(), frames, provenance)?;

    let others = stored.features.iter().filter(|set| {
        sources
            .iter()
            .all(|source| source.name != set.source().name)
    });
    features.extend(others.map(|set| set.select(&encoded.good)));

    Ok((room, features))
}
