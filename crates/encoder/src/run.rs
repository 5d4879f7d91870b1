//! Encodes a whole room. While the network runs on one batch, the images of the next one are
//! decoded. Rows are written to a journal as soon as they are computed. Memory holds all rows of
//! the room, but the images of only two batches.

use std::collections::BTreeMap;

use ndarray::Array2;
use rayon::prelude::*;

use super::journal::{EncodedFrame, NumberedFrames};
use super::{Encoder, Error, Journal};
use seese3_core::cancel::Cancellation;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::Keypoints;
use seese3_core::room::{FrameId, Timeline};

/// What to do with a frame whose image cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnBadImage {
    /// End the run with an error that names the image.
    Stop,
    /// Skip the frame, and list it in [`Encoded::bad`].
    Skip,
}

/// A room to encode.
pub struct Task<'a> {
    /// The order of its frames; a clip never leaves the sequence of its anchor.
    pub timeline: &'a Timeline,
    /// Reads the image of the frame in this row; it is called from several threads.
    pub image: &'a (dyn Fn(usize) -> Result<RgbImage, Error> + Sync),
    /// The number of frames in one batch.
    pub batch: usize,
    /// What to do with a frame whose image cannot be read.
    pub on_bad: OnBadImage,
    /// Stops the run between two batches; the rows in the journal are kept.
    pub cancel: &'a Cancellation,
}

/// The result of [`encode_room`].
#[derive(Debug)]
pub struct Encoded {
    /// Features of the good frames, shape (good frames, sum of [`Encoder::dims`]), with the columns
    /// of all layers side by side.
    pub rows: Array2<f32>,
    /// Keypoints of the good frames; empty if the encoder detects none.
    pub keypoints: Vec<Keypoints>,
    /// For each row of features, the row of its frame in the room, ascending.
    pub good: Vec<usize>,
    /// The skipped frames, each with the reason.
    pub bad: Vec<(usize, String)>,
    /// The number of frames that an earlier run had already encoded.
    pub resumed: usize,
}

/// A journal, and the frames that were in it when it was opened.
pub struct Kept<'a> {
    /// New frames are appended to it batch by batch.
    pub journal: &'a mut Journal,
    /// The frames that [`Journal::open`] found in it.
    pub before: NumberedFrames,
}

/// Encodes every frame, on the threads of the calling rayon pool. `done` is called with the number
/// of frames that are finished.
///
/// # Errors
/// [`Error::BadImage`] or [`Error::Io`] for the first image that cannot be read, unless those are
/// skipped; [`Error::Io`] if the journal cannot be written; [`Error::Runtime`] or
/// [`Error::NotFinite`] if the network fails; [`Error::Cancelled`] if the run was stopped.
pub fn encode_room(
    task: &Task<'_>,
    encoder: &Encoder,
    mut kept: Option<Kept<'_>>,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Encoded, Error> {
    let frame_count = task.timeline.frame_count;

    let before = kept
        .as_mut()
        .map(|kept| std::mem::take(&mut kept.before))
        .unwrap_or_default();

    // Frames are kept by number, so that those of the journal and the new ones end up in the order
    // of the room.
    let mut frames: BTreeMap<usize, EncodedFrame> = before
        .into_iter()
        .filter(|(row, _)| *row < frame_count)
        .collect();

    let resumed = frames.len();
    done(resumed);
    let open: Vec<usize> = (0..frame_count)
        .filter(|row| !frames.contains_key(row))
        .collect();
    let mut chunks = open.chunks(task.batch.max(1));

    let mut bad = Vec::new();

    // A pipeline of two batches: the network runs on the one that is ready, while the images of the
    // next one are read and resized.
    let mut ready = chunks
        .next()
        .map(|chunk| prepare(task, encoder, chunk))
        .transpose()?;

    while let Some(clips) = ready.take() {
        task.cancel.check()?;
        let next = chunks.next();
        let (encoded, prepared) = rayon::join(
            || clips.encode(encoder),
            || next.map(|chunk| prepare(task, encoder, chunk)).transpose(),
        );
        let encoded = encoded?;

        // These frames are written before an error of the next batch is returned, so that they are
        // not encoded a second time.
        if let Some(kept) = &mut kept {
            kept.journal
                .append(clips.good.iter().copied().zip(&encoded))?;
        }

        frames.extend(clips.good.iter().copied().zip(encoded));

        bad.extend(clips.bad);
        done(frames.len() + bad.len());
        ready = prepared?;
    }

    let good: Vec<usize> = frames.keys().copied().collect();
    let width = encoder.dims().iter().sum();
    let mut numbers = Vec::with_capacity(good.len() * width);
    let mut keypoints = Vec::new();
    for frame in frames.into_values() {
        numbers.extend(frame.feature);
        keypoints.extend(frame.keypoints);
    }

    let rows =
        Array2::from_shape_vec((good.len(), width), numbers).map_err(|error| Error::Runtime {
            runtime: encoder.runtime(),
            problem: error.into(),
        })?;

    Ok(Encoded {
        rows,
        keypoints,
        good,
        bad,
        resumed,
    })
}

/// The clips of one batch, with their prepared images.
struct Clips {
    images: BTreeMap<usize, RgbImage>,
    /// For each good anchor, the frames of its clip.
    frames: Vec<Vec<usize>>,
    good: Vec<usize>,
    bad: Vec<(usize, String)>,
}

impl Clips {
    fn encode(&self, encoder: &Encoder) -> Result<Vec<EncodedFrame>, Error> {
        let clips: Vec<Vec<&RgbImage>> = self
            .frames
            .iter()
            .map(|frames| frames.iter().map(|frame| &self.images[frame]).collect())
            .collect();
        encoder.encode_frames(&clips)
    }
}

fn prepare(task: &Task<'_>, encoder: &Encoder, anchors: &[usize]) -> Result<Clips, Error> {
    let frames: Vec<Vec<usize>> = anchors
        .iter()
        .map(|&row| clip(task.timeline, row, encoder.window()))
        .collect();

    // The clips of neighboring frames overlap, and each image is read only once.
    let mut wanted: Vec<usize> = frames.iter().flatten().copied().collect();
    wanted.sort_unstable();

    wanted.dedup();

    let read = |row: usize| {
        (
            row,
            (task.image)(row).and_then(|image| encoder.prepare(image)),
        )
    };
    let read: Vec<(usize, Result<RgbImage, Error>)> = wanted.into_par_iter().map(read).collect();

    let mut clips = Clips {
        images: BTreeMap::new(),
        frames: Vec::new(),
        good: Vec::new(),
        bad: Vec::new(),
    };

    // Only a fault of the image itself may be skipped. Otherwise, a failing disk would skip the
    // rest of the room.
    let mut problems = BTreeMap::new();
    for (row, image) in read {
        match image {
            Ok(image) => drop(clips.images.insert(row, image)),
            Err(error) if task.on_bad == OnBadImage::Stop => return Err(error),
            Err(error) if is_of_the_image(&error) => drop(problems.insert(row, error.to_string())),
            Err(error) => return Err(error),
        }
    }

    // A frame is skipped only if its own image is bad.
    for (&anchor, frames) in anchors.iter().zip(frames) {
        match problems.get(&anchor) {
            Some(problem) => clips.bad.push((anchor, problem.clone())),
            None => {
                let good = |frame: &usize| clips.images.contains_key(frame);

                // A bad frame elsewhere in the clip is replaced by the nearest good frame of the
                // clip.
                let stand_in = |frame: usize| {
                    frames
                        .iter()
                        .copied()
                        .filter(good)
                        .min_by_key(|other| other.abs_diff(frame))
                        .unwrap_or(anchor)
                };

                clips
                    .frames
                    .push(frames.iter().map(|&frame| stand_in(frame)).collect());

                clips.good.push(anchor);
            }
        }
    }

    Ok(clips)
}

/// Whether an error is due to a damaged or missing image, and not to the disk or the runtime.
fn is_of_the_image(error: &Error) -> bool {
    match error {
        Error::BadImage { .. } => true,
        Error::Io { cause, .. } => cause.kind() == std::io::ErrorKind::NotFound,
        _ => false,
    }
}

/// The frames of the clip around an anchor. The anchor has position ⌊`window` / 2⌋. Beyond the ends
/// of the sequence, its first or last frame is repeated.
fn clip(timeline: &Timeline, anchor: usize, window: usize) -> Vec<usize> {
    let joined = |row: usize| timeline.joins(FrameId(anchor as u32), FrameId(row as u32));
    let mut frames = Vec::with_capacity(window);
    for place in 0..window {
        let before = (window / 2).saturating_sub(place);
        let after = place.saturating_sub(window / 2);
        let mut frame = anchor;

        // Walk from the anchor frame by frame, and stop at the border of its sequence.
        for _ in 0..before.max(after) {
            let next = if before > 0 {
                frame.checked_sub(1)
            } else {
                Some(frame + 1)
            };

            match next.filter(|&row| row < timeline.frame_count && joined(row)) {
                Some(next) => frame = next,
                None => break,
            }
        }

        frames.push(frame);
    }

    frames
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand, on two sequences of three frames.
    #[test]
    fn clips_stay_in_their_sequence() {
        let timeline = Timeline {
            frame_count: 6,
            sequences: vec![0, 0, 0, 1, 1, 1],
            held_out: Vec::new(),
        };

        assert_eq!(clip(&timeline, 1, 1), [1]);
        assert_eq!(clip(&timeline, 1, 3), [0, 1, 2]);
        assert_eq!(clip(&timeline, 2, 3), [1, 2, 2]);
        assert_eq!(clip(&timeline, 3, 4), [3, 3, 3, 4]);

        assert_eq!(clip(&timeline, 5, 5), [3, 4, 5, 5, 5]);
    }

    fn kept(journal: &mut Journal, before: NumberedFrames) -> Option<Kept<'_>> {
        Some(Kept { journal, before })
    }

    fn image(row: usize) -> Result<RgbImage, Error> {
        if row == 3 {
            return Err(Error::BadImage {
                image: "frame 3".to_owned(),
                problem: "is cut".into(),
            });
        }

        let bytes = (0..64 * 48 * 3)
            .map(|i| ((i * (row + 1)) % 251) as u8)
            .collect();

        Ok(RgbImage {
            width: 64,
            height: 48,
            bytes,
        })
    }

    /// Oracle: the encoder called on each image alone. A second run requests only the images that
    /// the first one did not finish.
    #[test]
    fn an_interrupted_run_goes_on_and_gives_the_same_rows() {
        let timeline = Timeline::unbroken(8);
        let encoder = Encoder::builtin();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows");

        let cancel = Cancellation::default();
        let asked = std::sync::Mutex::new(Vec::new());

        let counting = |row: usize| {
            asked.lock().unwrap().push(row);
            if row >= 5 {
                cancel.cancel()
            }

            image(row)
        };

        let task = |image, on_bad| Task {
            timeline: &timeline,
            image,
            batch: 2,
            on_bad,
            cancel: &cancel,
        };

        let (mut journal, before) = Journal::open(&path, "k").unwrap();
        let first = encode_room(
            &task(&counting, OnBadImage::Skip),
            &encoder,
            kept(&mut journal, before),
            &|_| (),
        );

        assert!(matches!(first, Err(Error::Cancelled(_))));

        drop(journal);
        asked.lock().unwrap().clear();
        let (mut journal, before) = Journal::open(&path, "k").unwrap();
        let done = before.len();

        assert!(done >= 2, "something was journalled");

        let go_on = Cancellation::default();

        let again = |row: usize| {
            asked.lock().unwrap().push(row);
            image(row)
        };

        let task = Task {
            timeline: &timeline,
            image: &again,
            batch: 2,
            on_bad: OnBadImage::Skip,
            cancel: &go_on,
        };

        let found = encode_room(&task, &encoder, kept(&mut journal, before), &|_| ()).unwrap();
        assert_eq!(found.resumed, done);
        assert_eq!(asked.lock().unwrap().len(), 8 - done);
        assert_eq!(found.good, [0, 1, 2, 4, 5, 6, 7]);

        assert_eq!(found.bad.len(), 1);
        assert!(found.bad[0].1.contains("frame 3: is cut"));

        for (row, &frame) in found.rows.outer_iter().zip(&found.good) {
            assert_eq!(
                row.to_vec(),
                super::super::encode_builtin(&image(frame).unwrap())
            );
        }
    }

    /// Oracle: by hand. Of clips of three around frames 2, 3 and 4, with frame 3 bad, only frame 3
    /// is skipped.
    #[test]
    fn a_bad_image_costs_its_own_frame_alone() {
        let timeline = Timeline::unbroken(8);
        let mut encoder = Encoder::builtin();
        encoder.window = 3;
        let cancel = Cancellation::default();

        let task = Task {
            timeline: &timeline,
            image: &image,
            batch: 8,
            on_bad: OnBadImage::Skip,
            cancel: &cancel,
        };

        let clips = prepare(&task, &encoder, &[2, 3, 4]).unwrap();
        assert_eq!((clips.good, clips.bad.len()), (vec![2, 4], 1));
        assert_eq!(clips.frames, [[1, 2, 2], [4, 4, 5]]);
    }

    /// Oracle: the definition of [`OnBadImage::Stop`]: the error names the image, and no rows are
    /// returned.
    #[test]
    fn a_bad_image_stops_the_run_by_name() {
        let timeline = Timeline::unbroken(8);
        let encoder = Encoder::builtin();
        let folder = tempfile::tempdir().unwrap();
        let (mut journal, before) = Journal::open(&folder.path().join("rows"), "k").unwrap();

        let cancel = Cancellation::default();
        let task = Task {
            timeline: &timeline,
            image: &image,
            batch: 3,
            on_bad: OnBadImage::Stop,
            cancel: &cancel,
        };

        let error = encode_room(&task, &encoder, kept(&mut journal, before), &|_| ()).unwrap_err();
        assert_eq!(error.to_string(), "frame 3: is cut");
    }
}
