//! The images of a stored room: read from its folder, or drawn again for a room of `seese3 studio`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use strum::VariantArray;

use super::super::encode::images_root;
use seese3_core::geometry::Pose;
use seese3_core::image::RgbImage;
use seese3_core::room::Room;
use seese3_encoder::read_image;
use seese3_studio::{Film, Suite, Variation};

/// Where the images of a room come from.
pub enum RoomImages<'a> {
    /// A folder, and the paths of the images in it.
    Folder { root: PathBuf, images: &'a [String] },
    /// A film that is drawn again, at this size.
    Film {
        film: Box<Film>,
        size: (usize, usize),
    },
}

impl<'a> RoomImages<'a> {
    /// The images of a room. `folder` replaces the folder of the import; `size` (width, height) is
    /// that of drawn images.
    pub fn of(room: &'a Room, folder: Option<&Path>, size: (usize, usize)) -> anyhow::Result<Self> {
        if room.images().is_empty()
            && let Some(film) = film(room)
        {
            return Ok(Self::Film {
                film: Box::new(film),
                size,
            });
        }

        Ok(Self::Folder {
            root: images_root(room, folder)?,
            images: room.images(),
        })
    }

    /// The file of the image of the frame in `row`; `None` if it is drawn, or part of another file.
    pub fn file(&self, row: usize) -> Option<PathBuf> {
        match self {
            Self::Folder { root, images } => {
                Some(root.join(&images[row])).filter(|file| file.is_file())
            }
            Self::Film { .. } => None,
        }
    }

    /// The image of the frame in `row`.
    pub fn image(&self, row: usize) -> Result<RgbImage, seese3_encoder::Error> {
        match self {
            Self::Folder { root, images } => read_image(root, &images[row]),
            Self::Film {
                film,
                size: (width, height),
            } => Ok(film.image(row, *width, *height)),
        }
    }
}

/// The film of a room that `seese3 studio` drew, by its name, format and poses; `None` if the room
/// is not one.
fn film(room: &Room) -> Option<Film> {
    let (seed, number) = room.id().as_str().strip_prefix("studio")?.split_once('-')?;
    let seed = seed.parse().ok()?;
    let number = number.parse().ok()?;
    let format = room.provenance().format.strip_prefix("studio ")?;
    let mut parts = format.split(" without ");
    let kind = parts.next()?;
    let without: Vec<Variation> = parts.map(str::parse).collect::<Result<_, _>>().ok()?;

    let film = Suite::VARIANTS
        .iter()
        .map(|suite| suite.film(seed, number, room.frame_count()))
        .find(|film| film.kind == kind && has_poses(room, &film.poses))?;
    Some(without.into_iter().fold(film, Film::without))
}

/// Whether these are the poses of the room, up to 1e-9 in each entry of the homogeneous matrices.
fn has_poses(room: &Room, poses: &[Pose]) -> bool {
    let is_near = |(a, b): (&Pose, &Pose)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-9;
    poses.len() == room.frame_count() && poses.iter().zip(room.poses()).all(is_near)
}

/// The model of a room's keypoints: the given file, or the one that the room was encoded with.
pub fn keypoint_model(given: Option<&Path>, recorded: &str) -> anyhow::Result<PathBuf> {
    let file = given.map_or_else(|| PathBuf::from(recorded), Path::to_owned);
    if !file.is_file() {
        bail!(
            "'{}' is not a file; give the model that the room was encoded with by --keypoint-encoder FILE",
            file.display()
        );
    }
    file.canonicalize()
        .with_context(|| file.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use seese3_core::room::{Frames, Provenance, RoomId};

    /// A room with the frames of a film, as `seese3 studio` names it.
    fn drawn(film: &Film, format: String) -> Room {
        let frames = Frames {
            poses: film.poses.clone(),
            ..Frames::default()
        };
        let provenance = Provenance {
            format,
            ..Provenance::default()
        };
        Room::new(RoomId::new("studio5-0003").unwrap(), frames, provenance).unwrap()
    }

    /// Oracle: the film itself, and that a room with another pose is not the film's.
    #[test]
    fn rooms_of_every_suite_are_drawn_again() {
        let size = (32, 24);
        for suite in Suite::VARIANTS {
            let film = suite.film(5, 3, 6).without(Variation::Light);
            let room = drawn(&film, format!("studio {} without light", film.kind));
            let images = RoomImages::of(&room, None, size).unwrap();
            assert_eq!(images.image(4).unwrap(), film.image(4, 32, 24), "{suite:?}");
            assert!(images.file(4).is_none());

            let mut moved = film.clone();
            moved.poses[5].translation.vector.x += 1e-6;
            let other = drawn(&moved, room.provenance().format.clone());
            assert!(RoomImages::of(&other, None, size).is_err(), "{suite:?}");
        }
    }
}
