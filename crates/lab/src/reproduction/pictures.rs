//! Pictures: walks as strips of images, and a recording's path before and after the adapter.

use std::sync::Arc;

use nalgebra::SymmetricEigen;
use ndarray::{Array2, ArrayView2, Axis, s};
use serde::Serialize;

use seese3_core::adapter::{Adapter, Reading};
use seese3_core::cancel::Cancellation;
use seese3_core::image::RgbImage;
use seese3_core::matrices::to_nalgebra;
use seese3_core::navigation::{
    Displacement, FitOn, IndexKind, Limits, Mode, Navigator, Query, RetrievalMetric, Source,
    SourceAt, StepKind,
};
use seese3_core::room::FrameId;
use seese3_core::splits::Split;
use seese3_core::training::RoomData;

use super::notes::Notes;
use super::plans::steady_adapter;
use super::render::plotted;
use super::{Error, FeatureSet, Found, Images, Reproduction};
use crate::report::{Curves, Section, Series};

/// Equal parts of a walk, as in the paper.
const STEPS: u32 = 4;
/// The largest number of rooms whose walks are shown.
const SHOWN: usize = 3;
/// Frames from the source to the target of a walk: farther than any training pair of preset steady.
const FAR: u32 = 50;
/// Width of an image in a strip, pixels.
const WIDTH: usize = 200;

/// A walk in `record.json`.
#[derive(Debug, Serialize)]
pub struct WalkRecord {
    room: String,
    frames: Vec<u32>,
    metres_off: f64,
    degrees_off: f64,
}

/// The section of walks in held-out rooms that have images, and of the paths of features and
/// latents.
pub fn section(given: &Reproduction<'_>, notes: &Notes) -> Result<Found<Vec<WalkRecord>>, Error> {
    let mut section = Section::new("Walks in rooms never seen, and a recording unrolled");
    // Pictures are of the first feature set alone.
    let set = &given.sets[0];
    let adapter = notes
        .adapter(&steady_adapter(set), &set.features)
        .ok_or_else(|| Error::Input("the steady adapter was not trained".to_owned()))?;
    let adapter = Arc::new(adapter.clone());

    let mut record = Vec::new();

    // Only rooms that the studio rendered, and whose images are named in the store.
    let from_studio = |room: &&RoomData<'_>| {
        room.room.provenance().format.starts_with("studio") && !room.room.images().is_empty()
    };

    for (position, room) in set.test.iter().filter(from_studio).take(SHOWN).enumerate() {
        let room_of = Arc::new(room.room.clone());
        let navigator = Navigator::new(room_of, room.features, adapter.clone(), IndexKind::Exact)?;
        let walk = walked(&navigator)?;
        let strip = strip(given.images, room, &walk.frames)?;

        let caption = format!(
            "Room {}: source, {STEPS} steps in an open loop, target; the last step is {:.2} m and {:.0}° from it",
            room.room.id(),
            walk.metres_off,
            walk.degrees_off
        );
        section.picture(format!("walk-{position}.png"), strip, caption);

        record.push(WalkRecord {
            room: room.room.id().to_string(),
            frames: walk.frames,
            metres_off: walk.metres_off,
            degrees_off: walk.degrees_off,
        });
    }

    if record.is_empty() {
        section.text("No held-out room is a drawn one with images; walks are not shown.");
    }

    // Before: the features. After: the part of their latents that a motion can change.
    let (before, after) = unrolled(set, &adapter)?;
    section.picture(
        "unrolled-before.svg",
        before,
        "A recording's features: the two directions in which they vary most, by part of the way",
    );

    section.picture(
        "unrolled-after.svg",
        after,
        "The same frames' latents in the row space of W",
    );

    section.text("Adapter of preset steady, learned from all rooms that are learned together; neither room nor frames were seen.");
    Ok(Found { section, record })
}

/// A walk from a source to a target.
struct Walk {
    /// The source first, the target last.
    frames: Vec<u32>,
    /// The distance of the walk's end from the target, metres.
    metres_off: f64,
    /// The angle between the walk's end and the target, degrees.
    degrees_off: f64,
}

fn walked(navigator: &Navigator) -> Result<Walk, Error> {
    let count = navigator.room().frame_count() as u32;
    let source = count / 4;
    let target = (source + FAR).min(count - 1);

    let query = Query {
        source: SourceAt {
            source: Source::Frame(FrameId(source)),
            pose: None,
        },
        displacement: Displacement::TargetFrame(FrameId(target)),
        steps: STEPS,
        mode: Mode::OpenLoop,
        step: StepKind::InversePoincare(Reading::Homogeneous),
        metric: RetrievalMetric::Full,
        // Only a refit is fitted on pairs of the room; inverse Poincaré ignores this.
        fit_on: FitOn {
            split: Split::Time,
            stride: FAR,
        },
        hit_count: 1,
        exclude_source: None,
    };

    let answer = navigator.answer(&query, Limits::default(), &Cancellation::default())?;

    // Each step shows the frame that was retrieved for it.
    let steps = answer
        .steps
        .iter()
        .map(|step| step.hits[0].neighbour.frame.0);
    let frames = [source].into_iter().chain(steps).chain([target]).collect();

    // The error is that of the frame retrieved by the last step.
    let error = answer
        .steps
        .last()
        .and_then(|step| step.error)
        .ok_or_else(|| Error::Input("a walk between frames has an error".to_owned()))?;

    Ok(Walk {
        frames,
        metres_off: error.pose.translation_m,
        degrees_off: error.pose.rotation_rad.to_degrees(),
    })
}

/// Images side by side, as a PNG file.
fn strip(images: &dyn Images, data: &RoomData<'_>, frames: &[u32]) -> Result<Vec<u8>, Error> {
    let source = images;
    let mut images = Vec::with_capacity(frames.len());
    for &frame in frames {
        let image = source
            .read(data.room, FrameId(frame))
            .map_err(Error::Input)?;
        images.push(smaller(&image));
    }

    // The first image gives the height: a lower one leaves white below it, a higher one is cut off.
    let height = images[0].height;
    let gap = 4;
    let width = images.len() * (WIDTH + gap) - gap;
    let mut bytes = vec![255; width * height * 3];

    for (position, image) in images.iter().enumerate() {
        for row in 0..height.min(image.height) {
            let at = (row * width + position * (WIDTH + gap)) * 3;
            bytes[at..at + WIDTH * 3]
                .copy_from_slice(&image.bytes[row * WIDTH * 3..(row + 1) * WIDTH * 3]);
        }
    }

    let strip = RgbImage {
        width,
        height,
        bytes,
    };
    source.png(&strip).map_err(Error::Input)
}

/// The image scaled to [`WIDTH`]: each pixel is the mean of the pixels that it covers.
fn smaller(image: &RgbImage) -> RgbImage {
    let height = (image.height * WIDTH / image.width).max(1);
    let mut bytes = Vec::with_capacity(WIDTH * height * 3);
    for row in 0..height {
        for column in 0..WIDTH {
            // The range of source pixels under a target pixel, at least one.
            let span = |at: usize, of: usize, from: usize| {
                at * from / of..((at + 1) * from / of).max(at * from / of + 1)
            };
            let rows = span(row, height, image.height);

            let columns = span(column, WIDTH, image.width);
            for channel in 0..3 {
                let mut sum = 0usize;
                let mut n = 0usize;
                for y in rows.clone() {
                    for x in columns.clone() {
                        sum += usize::from(image.pixel(x, y)[channel]);
                        n += 1;
                    }
                }

                bytes.push((sum / n.max(1)) as u8);
            }
        }
    }

    RgbImage {
        width: WIDTH,
        height,
        bytes,
    }
}

/// The path of the first held-out room, drawn from its features and from its latents in the row
/// space of W, each in its two principal directions.
fn unrolled(set: &FeatureSet<'_>, adapter: &Adapter) -> Result<(Vec<u8>, Vec<u8>), Error> {
    let data = &set.test[0];
    let features = data.features;

    // σ ⊙ W keeps the part of a latent that a motion can change, as six numbers.
    let latents = adapter.embed(features.rows())?;
    let coordinates = latents.slice(s![.., ..adapter.coordinate_count()]);
    let motion = coordinates.dot(&adapter.motion_of_coordinates()?.t());

    let plot = |title: String, rows: Array2<f64>| {
        let series = parts(&rows);
        plotted(&Curves {
            title,
            x: "first direction".to_owned(),
            y: "second direction".to_owned(),
            series,
            diagonal: false,
        })
    };

    let name = data.room.id();
    let before = plot(
        format!("{name}: features"),
        main_directions(features.rows().mapv(f64::from).view()),
    )?;

    let after = plot(format!("{name}: σ ⊙ W φ"), main_directions(motion.view()))?;
    Ok((before, after))
}

/// The path in four named parts, so that its direction can be seen.
fn parts(rows: &Array2<f64>) -> Vec<Series> {
    let quarter = rows.nrows().div_ceil(4).max(1);
    rows.axis_chunks_iter(Axis(0), quarter)
        .zip(["first quarter", "second", "third", "last"])
        .map(|(chunk, name)| Series {
            name: name.to_owned(),
            points: chunk.outer_iter().map(|row| [row[0], row[1]]).collect(),
            joined: true,
        })
        .collect()
}

/// The rows' scores on their two principal components, shape (n, 2).
fn main_directions(rows: ArrayView2<'_, f64>) -> Array2<f64> {
    let centred = &rows - &(rows.sum_axis(Axis(0)) / rows.nrows().max(1) as f64);

    // The two Gram matrices share their eigenvalues above zero; the smaller one is decomposed.
    let wide = centred.ncols() > centred.nrows();
    let gram = if wide {
        centred.dot(&centred.t())
    } else {
        centred.t().dot(&centred)
    };
    let eigen = SymmetricEigen::new(to_nalgebra(gram.view()));

    // Eigenvalues come in no order: the largest belong to the directions of largest variance.
    let mut order: Vec<usize> = (0..gram.nrows()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));

    // From X Xᵀ a score is the eigenvector's entry times the singular value; from XᵀX it is the
    // row's projection on the eigenvector.
    let main = |which: usize, row: usize| match order.get(which) {
        None => 0.0,
        Some(&at) if wide => eigen.eigenvectors[(row, at)] * eigen.eigenvalues[at].max(0.0).sqrt(),
        Some(&at) => centred
            .row(row)
            .iter()
            .enumerate()
            .map(|(c, x)| x * eigen.eigenvectors[(c, at)])
            .sum(),
    };

    Array2::from_shape_fn((rows.nrows(), 2), |(row, which)| main(which, row))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Points along (3, 4) lie along one line; wide rows give what tall ones give,
    /// up to sign.
    #[test]
    fn the_main_direction_is_where_rows_vary_most() {
        let rows = Array2::from_shape_fn((5, 2), |(i, c)| i as f64 * [3.0, 4.0][c]);
        let found = main_directions(rows.view());
        assert!(
            ((found[(4, 0)] - found[(0, 0)]).abs() - 20.0).abs() < 1e-9
                && found.column(1).iter().all(|x| x.abs() < 1e-6)
        );

        let wide = Array2::from_shape_fn((5, 9), |(i, c)| if c < 2 { rows[(i, c)] } else { 0.0 });
        let again = main_directions(wide.view());
        assert!((found[(4, 0)].abs() - again[(4, 0)].abs()).abs() < 1e-9);
    }

    /// Oracle: by hand: a pixel is the mean of those under it.
    #[test]
    fn a_smaller_image_is_the_mean() {
        let bytes = (0..400 * 2)
            .flat_map(|at| [if at % 2 == 0 { 10 } else { 30 }; 3])
            .collect();
        let found = smaller(&RgbImage {
            width: 400,
            height: 2,
            bytes,
        });

        assert_eq!((found.width, found.height), (200, 1));
        assert!(found.bytes.iter().all(|&value| value == 20));
    }
}
