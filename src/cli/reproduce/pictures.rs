//! What it looks like: walks as strips of images, and a recording before and after the adapter.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use nalgebra::{DMatrix, SymmetricEigen};
use ndarray::{Array2, ArrayView2, Axis, s};
use serde_json::{Value, json};

use super::cross::steady;
use super::in_room::plotted;
use super::notes::Notes;
use super::{Found, Loaded, Set, Setting};
use crate::adapter::Reading;
use crate::cancel::Cancellation;
use crate::encoder::{encode_png, read_image};
use crate::image::RgbImage;
use crate::navigation::{
    Displacement, FitOn, IndexKind, Limits, Metric, Mode, Navigator, Query, Source, SourceAt,
    StepKind,
};
use crate::pairs::Split;
use crate::report::{Curves, Section, Series};
use crate::room::FrameId;

/// Parts of a walk, as in the paper.
const STEPS: u32 = 4;
/// Rooms that are shown.
const SHOWN: usize = 3;
/// Frames from source to target of a shown walk: further than one training pair.
const FAR: u32 = 50;
/// The size of an image in a strip.
const WIDTH: usize = 200;

/// Strips of held-out rooms that have images, and the paths of features and latents.
pub fn section(setting: &Setting, notes: &Notes) -> anyhow::Result<Found> {
    let mut section = Section::new("Walks in rooms never seen, and a recording unrolled");
    let set = &setting.sets[0];
    let adapter = notes
        .adapter(&steady(set), &set.features)
        .context("the steady adapter was not learned")?;
    let adapter = Arc::new(adapter.clone());

    let mut record = Vec::new();
    let drawn = |room: &&Loaded| {
        room.0.room.provenance().format.starts_with("studio") && !room.0.room.images().is_empty()
    };

    for (position, room) in set.test.iter().filter(drawn).take(SHOWN).enumerate() {
        let room_of = Arc::new(room.0.room.clone());
        let navigator = Navigator::new(room_of, &room.1, adapter.clone(), IndexKind::Exact)?;
        let (walk, value) = walked(&navigator)?;
        let strip = strip(room, &walk)?;

        let caption = format!(
            "Room {}: source, {STEPS} steps in an open loop, target; the last step is {:.2} m and {:.0}° from it",
            room.0.room.id(),
            value.0,
            value.1
        );
        section.picture(format!("walk-{position}.png"), strip, caption);

        record.push(
            json!({ "room": room.0.room.id().as_str(), "frames": walk, "metres_off": value.0, "degrees_off": value.1 }),
        );
    }

    if record.is_empty() {
        section.text("No held-out room is a drawn one with images; walks are not shown.");
    }

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
    Ok((section, Value::Array(record)))
}

/// The frames of a walk, source first and target last, and how far its end is from the target,
/// metres and degrees.
fn walked(navigator: &Navigator) -> anyhow::Result<(Vec<u32>, (f64, f64))> {
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
        metric: Metric::Full,
        fit_on: FitOn {
            split: Split::Time,
            stride: FAR,
        },
        hit_count: 1,
        exclude_source: None,
    };

    let answer = navigator.answer(&query, Limits::default(), &Cancellation::default())?;
    let steps = answer
        .steps
        .iter()
        .map(|step| step.hits[0].neighbour.frame.0);
    let frames = [source].into_iter().chain(steps).chain([target]).collect();

    let error = answer
        .steps
        .last()
        .and_then(|step| step.error)
        .context("a walk between frames has an error")?;

    Ok((
        frames,
        (
            error.pose.translation_m,
            error.pose.rotation_rad.to_degrees(),
        ),
    ))
}

/// Images side by side, a PNG file.
fn strip(room: &Loaded, frames: &[u32]) -> anyhow::Result<Vec<u8>> {
    let stored = &room.0.room;
    let root = PathBuf::from(&stored.provenance().images_root);
    let mut images = Vec::with_capacity(frames.len());
    for &frame in frames {
        images.push(smaller(&read_image(
            &root,
            &stored.images()[frame as usize],
        )?));
    }

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

    Ok(encode_png(&RgbImage {
        width,
        height,
        bytes,
    })?)
}

/// An image of [`WIDTH`], each pixel the mean of those under it.
fn smaller(image: &RgbImage) -> RgbImage {
    let height = (image.height * WIDTH / image.width).max(1);
    let mut bytes = Vec::with_capacity(WIDTH * height * 3);
    for row in 0..height {
        for column in 0..WIDTH {
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

/// The first held-out room's path in features, and in the row space of W, each in its two main
/// directions.
fn unrolled(set: &Set, adapter: &crate::adapter::Adapter) -> anyhow::Result<(Vec<u8>, Vec<u8>)> {
    let (stored, features) = &set.test[0];
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

    let name = stored.room.id();
    let before = plot(
        format!("{name}: features"),
        main_directions(features.rows().mapv(f64::from).view()),
    )?;

    let after = plot(format!("{name}: σ ⊙ W φ"), main_directions(motion.view()))?;
    Ok((before, after))
}

/// The way in four parts, so that its direction is seen.
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

/// Rows in the two directions in which they vary most, shape (n, 2).
fn main_directions(rows: ArrayView2<'_, f64>) -> Array2<f64> {
    let centred = &rows - &(rows.sum_axis(Axis(0)) / rows.nrows().max(1) as f64);

    // Of the smaller of the two Gram matrices: rows are fewer than columns, or the other way round.
    let wide = centred.ncols() > centred.nrows();
    let gram = if wide {
        centred.dot(&centred.t())
    } else {
        centred.t().dot(&centred)
    };
    let eigen = SymmetricEigen::new(DMatrix::from_fn(gram.nrows(), gram.nrows(), |i, j| {
        gram[(i, j)]
    }));

    let mut order: Vec<usize> = (0..gram.nrows()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));

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
            (found[(4, 0)] - found[(0, 0)]).abs() - 20.0 < 1e-9
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
