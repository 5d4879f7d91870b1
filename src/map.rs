//! `seese3 map`: parts of rooms, other world frames, and joined rooms. Each command publishes a new
//! room.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::output::{JsonOutput, say, say_published};
use seese3_core::geometry::Pose;
use seese3_core::nalgebra::{Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector3};
use seese3_core::room::RoomId;
use seese3_core::trajectory::Similarity;
use seese3_robot::localization::{KeypointRoom, MapAlignment};
use seese3_store::{EditedRoom, Store, StoredRoom};

/// Largest difference of a stated transform from a similarity, relative to its scale.
const MAX_DEVIATION: f64 = 1e-3;

#[derive(Debug, Args)]
pub struct Map {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Keep a part of a room's frames
    Crop(Crop),
    /// Move a room to another world frame, by a stated transform
    Transform(Transform),
    /// Move a room to the world frame of another one, by the keypoints that both show
    Align(Align),
    /// Join the frames of two rooms. Features that only one of them has are left out
    Merge(Merge),
}

#[derive(Debug, Args)]
struct Common {
    /// The store
    #[arg(long, env = "SEESE3_STORE", default_value = crate::store_option::DEFAULT_STORE)]
    store: String,
    /// The room
    #[arg(long)]
    room: String,
    /// Name of the new room
    #[arg(long)]
    name: String,
    #[command(flatten)]
    json: JsonOutput,
}

#[derive(Debug, Args)]
struct Crop {
    #[command(flatten)]
    common: Common,
    /// Keep the frames whose cameras are in this box, world frame, meters
    #[arg(long = "box", value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = parse_box, allow_hyphen_values = true)]
    within: Option<BoundingBox>,
    /// Keep the frames outside --box instead
    #[arg(long, requires = "within")]
    outside: bool,
    /// Keep these rows: FIRST..END, counted from 0; END is left out
    #[arg(long, value_parser = parse_rows, required_unless_present = "within")]
    rows: Option<std::ops::Range<usize>>,
}

#[derive(Debug, Args)]
struct Transform {
    #[command(flatten)]
    common: Common,
    /// A text file with a 4x4 matrix, new_from_old, meters: a rotation times a scale, and a
    /// translation
    #[arg(long, value_name = "FILE")]
    matrix: PathBuf,
}

#[derive(Debug, Args)]
struct Align {
    #[command(flatten)]
    common: Common,
    /// The room whose world frame is taken
    #[arg(long)]
    to: String,
    /// Estimate the scale of the room, too
    #[arg(long)]
    with_scale: bool,
}

#[derive(Debug, Args)]
struct Merge {
    #[command(flatten)]
    common: Common,
    /// The room whose frames are added
    #[arg(long)]
    add: String,
    /// Align the added room first, by the keypoints that both show; otherwise both are in one world
    /// frame
    #[arg(long)]
    align: bool,
    /// Estimate the scale of the added room, too
    #[arg(long, requires = "align")]
    with_scale: bool,
}

/// Least and greatest coordinates.
type BoundingBox = [Vector3<f64>; 2];

impl Map {
    pub async fn run(self) -> anyhow::Result<()> {
        match self.what {
            What::Crop(crop) => crop.run().await,
            What::Transform(transform) => transform.run().await,
            What::Align(align) => align.run().await,
            What::Merge(merge) => merge.run().await,
        }
    }
}

impl Common {
    /// The store, the room, and the new name.
    async fn open(&self) -> anyhow::Result<(Store, StoredRoom, RoomId)> {
        self.json.begin()?;
        let store = Store::open(&self.store)?;
        store.check_writable().await?;
        let name = RoomId::new(&self.name).context("--name")?;
        let rooms = store.rooms().await?;
        if rooms.iter().any(|room| room.room == self.name) {
            bail!("--name: room '{}' exists; choose another name", self.name);
        }
        let stored = store.load_room(&self.room, None).await?;
        Ok((store, stored, name))
    }

    async fn publish(&self, store: &Store, edited: &EditedRoom, more: Value) -> anyhow::Result<()> {
        let published = store.publish_contents(edited.contents()).await?;
        let count = edited.room().frame_count();
        say(format_args!("{count} frames"));
        say_published(store, &format!("room '{}'", self.name), &published);
        let mut record = json!({
            "room": self.name,
            "revision": published.revision,
            "frame_count": count,
        });
        if let (Value::Object(record), Value::Object(more)) = (&mut record, more) {
            record.extend(more);
        }
        self.json.write(&record)
    }
}

impl Crop {
    async fn run(self) -> anyhow::Result<()> {
        let (store, stored, name) = self.common.open().await?;
        let count = stored.room.frame_count();
        if let Some(rows) = &self.rows
            && rows.end > count
        {
            bail!("--rows: room '{}' has {count} frames", self.common.room);
        }

        let is_kept = |row: &usize| {
            let position = stored.room.poses()[*row].translation.vector;
            let is_inside = |[least, most]: &BoundingBox| {
                position
                    .iter()
                    .zip(least.iter().zip(most))
                    .all(|(at, (least, most))| (*least..=*most).contains(at))
            };
            let of_box = self
                .within
                .as_ref()
                .is_none_or(|within| is_inside(within) != self.outside);
            of_box && self.rows.as_ref().is_none_or(|rows| rows.contains(row))
        };
        let rows: Vec<usize> = (0..count).filter(is_kept).collect();
        if rows.is_empty() {
            bail!(
                "no frame of room '{}' is left; see its positions with `seese3 check`",
                self.common.room
            );
        }
        let edited = EditedRoom::of(&stored, &name)?.cropped(&rows)?;
        self.common.publish(&store, &edited, json!({})).await
    }
}

impl Transform {
    async fn run(self) -> anyhow::Result<()> {
        let similarity = read_similarity(&self.matrix)?;
        let (store, stored, name) = self.common.open().await?;
        let edited = EditedRoom::of(&stored, &name)?.transformed(&similarity)?;
        let more = json!({"new_from_old": matrix_rows(&similarity)});
        self.common.publish(&store, &edited, more).await
    }
}

impl Align {
    async fn run(self) -> anyhow::Result<()> {
        let (store, stored, name) = self.common.open().await?;
        let base = store.load_room(&self.to, None).await?;
        let found = aligned(&base, &stored, self.with_scale)?;
        let edited = EditedRoom::of(&stored, &name)?.transformed(&found.map_from_other)?;
        let more = json!({"alignment": alignment_json(&found)});
        self.common.publish(&store, &edited, more).await
    }
}

impl Merge {
    async fn run(self) -> anyhow::Result<()> {
        let (store, stored, name) = self.common.open().await?;
        let added = store.load_room(&self.add, None).await?;
        let found = if self.align {
            Some(aligned(&stored, &added, self.with_scale)?)
        } else {
            None
        };
        let mut addition = EditedRoom::of(&added, &name)?;
        if let Some(found) = &found {
            addition = addition.transformed(&found.map_from_other)?;
        }
        let edited = EditedRoom::of(&stored, &name)?.merged(&addition)?;
        let more = json!({"alignment": found.as_ref().map(alignment_json)});
        self.common.publish(&store, &edited, more).await
    }
}

/// Aligns a room to a base, and prints how well they agree.
fn aligned(
    base: &StoredRoom,
    other: &StoredRoom,
    with_scale: bool,
) -> anyhow::Result<MapAlignment> {
    let keypoints = |stored: &StoredRoom| {
        let name = stored.room.id().to_string();
        let problem = || {
            format!(
                "room '{name}' has no keypoints: encode it with `seese3 encode --recipe xfeat-keypoints`"
            )
        };
        stored.keypoints.clone().with_context(problem)
    };
    let (of_base, of_other) = (keypoints(base)?, keypoints(other)?);
    if !of_base.source.is_like(&of_other.source) {
        bail!(
            "the keypoints of '{}' and '{}' are of different encoders; encode both rooms in the same way",
            base.room.id(),
            other.room.id()
        );
    }

    let map = KeypointRoom::new(base.room.poses().to_vec(), of_base.map);
    let found = map.align(&of_other.map, other.room.poses(), with_scale)?;
    let [tried, located, agreeing] = found.counts;
    let [residual_m, residual_rad] = found.residuals;
    say(format_args!(
        "aligned by {agreeing} frames of {located} located ones, of {tried}: root mean squares {residual_m:.3} m and {:.2}°, \
         scale {:.4}",
        residual_rad.to_degrees(),
        found.map_from_other.scale,
    ));
    Ok(found)
}

fn alignment_json(found: &MapAlignment) -> Value {
    let [tried, located, agreeing] = found.counts;
    let [residual_m, residual_rad] = found.residuals;
    json!({
        "new_from_old": matrix_rows(&found.map_from_other),
        "scale": found.map_from_other.scale,
        "frames": {"tried": tried, "located": located, "agreeing": agreeing},
        "residual_m": residual_m,
        "residual_rad": residual_rad,
    })
}

fn matrix_rows(similarity: &Similarity) -> Vec<Vec<f64>> {
    let scale = Matrix4::new_scaling(similarity.scale);
    let matrix = similarity.reference_from_estimate.to_homogeneous() * scale;
    matrix
        .row_iter()
        .map(|row| row.iter().copied().collect())
        .collect()
}

/// A similarity from a text file of 16 numbers.
fn read_similarity(file: &Path) -> anyhow::Result<Similarity> {
    let shown = file.display();
    let text = seese3_files::read_text(file, seese3_files::SMALL_FILE_BYTES);
    let text = text.with_context(|| format!("{shown} cannot be read"))?;
    let numbers = text
        .split_whitespace()
        .map(str::parse)
        .collect::<Result<Vec<f64>, _>>();
    let numbers = numbers.with_context(|| format!("{shown} has something that is no number"))?;
    if numbers.len() != 16 || numbers.iter().any(|number| !number.is_finite()) {
        bail!("{shown} must have 16 finite numbers, the rows of a 4x4 matrix");
    }

    let matrix = Matrix4::from_row_slice(&numbers);
    let linear: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
    let scale = linear.determinant().cbrt();
    let is_rotation = scale > 0.0 && {
        let rotation = linear / scale;
        (rotation * rotation.transpose() - Matrix3::identity()).amax() < MAX_DEVIATION
    };
    let last: Vec<f64> = matrix.row(3).iter().copied().collect();
    if !is_rotation || last != [0.0, 0.0, 0.0, 1.0] {
        bail!(
            "{shown} must be a rotation times a scale, with a translation and the last row 0 0 0 1"
        );
    }
    let rotation = Rotation3::from_matrix(&(linear / scale));
    Ok(Similarity {
        scale,
        reference_from_estimate: Pose::from_parts(
            Vector3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]).into(),
            UnitQuaternion::from_rotation_matrix(&rotation),
        ),
    })
}

fn parse_box(text: &str) -> Result<BoundingBox, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(str::trim).map(str::parse).collect();
    let problem = "must be six numbers, X0,Y0,Z0,X1,Y1,Z1, with each least coordinate first";
    let numbers = numbers.map_err(|_| problem.to_owned())?;
    let [x0, y0, z0, x1, y1, z1] = numbers[..] else {
        return Err(problem.to_owned());
    };
    if x0 <= x1 && y0 <= y1 && z0 <= z1 {
        Ok([Vector3::new(x0, y0, z0), Vector3::new(x1, y1, z1)])
    } else {
        Err(problem.to_owned())
    }
}

fn parse_rows(text: &str) -> Result<std::ops::Range<usize>, String> {
    let problem = || "must be FIRST..END, for example 0..200".to_owned();
    let (first, end) = text.split_once("..").ok_or_else(problem)?;
    let [first, end] = [first, end].map(|number| number.trim().parse::<usize>());
    match (first, end) {
        (Ok(first), Ok(end)) if first < end => Ok(first..end),
        _ => Err(problem()),
    }
}
