//! Section: pictures. Walks as image strips and plan views, image pairs by stride, and the path of
//! a recording before and after the adapter.

mod plane;
mod strip;
mod unrolled;
mod walks;

use std::sync::Arc;
use strum::VariantArray;

use seese3_core::training::RoomData;

use super::adapters::Adapters;
use super::plans::steady_adapter;
use super::{Error, Found, Reproduction};
use crate::report::Section;
use walks::Length;
pub use walks::WalkRecord;

/// Builds the section with walks in rooms with images, and with the paths of features and latents.
pub fn section(
    given: &Reproduction<'_>,
    adapters: &Adapters,
) -> Result<Found<Vec<WalkRecord>>, Error> {
    let mut section = Section::new("Walks in held-out rooms, and a recording unrolled");
    // Pictures use only the first feature set.
    let set = &given.sets[0];
    let adapter = adapters
        .reproduced(&steady_adapter(set), &set.features)
        .ok_or_else(|| Error::Input("the steady adapter was not trained".to_owned()))?;
    let adapter = Arc::new(adapter.adapter.clone());
    section.text("Adapter of preset steady on all training rooms; none of them is shown.");

    let is_drawn = |data: &&RoomData<'_>| data.room.provenance().format.starts_with("studio");
    let has_images = |data: &&RoomData<'_>| !data.room.images().is_empty();
    let mut walks = Vec::new();

    // A held-out synthetic room, with a short, a middle and a long motion.
    let drawn = set.test.iter().filter(is_drawn).find(has_images);
    for &length in Length::VARIANTS {
        if let Some(data) = drawn {
            walks.push(walks::add(&mut section, given, data, &adapter, length)?);
        }
    }

    // A real room that the adapter was not trained on.
    let is_unseen = |data: &&RoomData<'_>| {
        let mut learned = set.train.iter();
        learned.all(|other| other.room.id() != data.room.id())
    };
    let rooms = set.test.iter().chain(&set.in_room);
    let mut real = rooms.filter(|data| !is_drawn(data) && is_unseen(data));
    let real = real.find(has_images);
    for &length in Length::VARIANTS {
        if let Some(data) = real {
            walks.push(walks::add(&mut section, given, data, &adapter, length)?);
        }
    }
    if walks.is_empty() {
        section.text("No such room has images; walks are not shown.");
    }

    // Example images at each stride.
    if let Some(data) = real.or(drawn) {
        let source = data.room.frame_count() as u32 / 4;
        let strides = given.options.strides.iter().copied();
        let frames: Vec<u32> = std::iter::once(0)
            .chain(strides)
            .map(|stride| (source + stride).min(data.room.frame_count() as u32 - 1))
            .collect();
        section.picture(
            "strides.png",
            strip::strip(given.images, data, &frames)?,
            format!(
                "Room {}: a source, and the targets {:?} frames on",
                data.room.id(),
                given.options.strides
            ),
        );
    }

    unrolled::add(&mut section, &set.test[0], &adapter)?;
    Ok(Found::new(section, walks))
}
