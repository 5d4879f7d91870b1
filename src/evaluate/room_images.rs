//! The images of a stored room: read from its folder, or drawn again for a room of `seese3 studio`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::super::encode::images_root;
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

/// The film of a room that `seese3 studio` drew, by its name and format; `None` if the room is not
/// one, or if its poses are not those of the film.
fn film(room: &Room) -> Option<Film> {
    let (seed, number) = room.id().as_str().strip_prefix("studio")?.split_once('-')?;
    let format = room.provenance().format.strip_prefix("studio ")?;
    let mut words = format.split(" without ");
    let suite: Suite = words.next()?.parse().ok()?;
    let without = words.map(str::parse).collect::<Result<Vec<Variation>, _>>();

    let film = suite.film(seed.parse().ok()?, number.parse().ok()?, room.frame_count());
    let film = without
        .ok()?
        .into_iter()
        .fold(film, |film, variation| film.without(variation));
    let is_same = film.poses.len() == room.frame_count()
        && film
            .poses
            .iter()
            .zip(room.poses())
            .all(|(a, b)| (a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-9);
    is_same.then_some(film)
}

/// The model of a room's keypoints: the given file, or the one that the room was encoded with.
pub fn keypoint_model(given: Option<&Path>, recorded: &str) -> anyhow::Result<PathBuf> {
    let file = given.map_or_else(|| PathBuf::from(recorded), Path::to_owned);
    if !file.is_file() {
        bail!(
            "{} is not a file; give the model that the room was encoded with by --model FILE",
            file.display()
        );
    }
    file.canonicalize()
        .with_context(|| file.display().to_string())
}
