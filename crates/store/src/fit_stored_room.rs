//! Fits an adapter to a stored room and publishes it in the same store.

use std::sync::Arc;

use seese3_core::adapter::Adapter;
use seese3_core::features::Features;
use seese3_core::room::{FrameId, RoomId, is_plain_name};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{self, FitRun, Fitted, fit};

use crate::{BaseAdapter, Published, RoomFit, Store, StoredAdapter, StoredRoom};

/// Errors of fitting an adapter to a stored room.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(transparent)]
    Store(#[from] crate::Error),
    #[error(transparent)]
    Fitting(#[from] fitting::Error),
    #[error(
        "adapter '{base}' was trained on room '{room}' or fitted to a room; use a base trained \
         only on other rooms, or no base"
    )]
    Base { base: String, room: String },
    #[error("{name:?} cannot name an adapter: use 1 to 100 letters, digits, '.', '-' or '_'")]
    Name { name: String },
    #[error("the name '{name}' is taken by an adapter that was not fitted to room '{room}'")]
    Taken { name: String, room: String },
}

/// Inputs of a fit.
#[derive(Debug, Clone)]
pub struct Request {
    /// The room to fit to; all its frames are mapped.
    pub room: String,
    /// The pre-trained adapter to start from, trained on other rooms; random initial weights if
    /// `None`.
    pub base: Option<String>,
    /// The feature set; if `None`, that of the base, or else the room's only one.
    pub features: Option<String>,
    /// Name of the fitted adapter; `ROOM.FEATURES.fitted` if `None`.
    pub name: Option<String>,
    /// Seed of the sampled pairs, the noise and, without a base, the initial weights.
    pub seed: u64,
}

/// A prepared fit: all inputs are loaded and checked.
#[derive(Debug)]
pub struct Refit {
    stored: StoredRoom,
    features: Features,
    base: Option<StoredAdapter>,
    name: String,
    seed: u64,
}

impl Refit {
    /// Loads and checks the inputs of a fit.
    ///
    /// # Errors
    /// [`Error::Base`] if the base was trained on the room, since its errors there would be
    /// underestimated, or was fitted to any room; [`Error::Name`] or [`Error::Taken`] if the name
    /// cannot be published; [`Error::Store`] if the room, its features or the base cannot be read.
    pub async fn prepare(store: &Store, request: Request) -> Result<Self, Error> {
        let base = match &request.base {
            Some(name) => Some(store.load_adapter(name, None).await?),
            None => None,
        };
        if let Some(base) = &base {
            check_base(base, &request.room)?;
        }

        let of_base = base
            .as_ref()
            .map(|stored| stored.adapter.source().name.clone());
        let wanted = request.features.or(of_base);
        let (stored, features) = store
            .load_room_with(&request.room, wanted.as_deref())
            .await?;

        let default_name = || format!("{}.{}.fitted", request.room, features.source().name);
        let name = request.name.unwrap_or_else(default_name);
        check_name(store, &name, stored.room.id()).await?;

        Ok(Self {
            stored,
            features,
            base,
            name,
            seed: request.seed,
        })
    }

    /// Name under which the fitted adapter is published.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The room and the features to fit to.
    pub fn data(&self) -> RoomData<'_> {
        RoomData {
            room: &self.stored.room,
            revision: self.stored.revision,
            features: &self.features,
        }
    }

    /// Runs the fit.
    ///
    /// # Errors
    /// [`Error::Fitting`], as [`fit`].
    pub fn fit(&self, run: FitRun<'_>) -> Result<Fitted, Error> {
        let frame_count = self.stored.room.frame_count();
        let mapped: Vec<FrameId> = (0..frame_count as u32).map(FrameId).collect();
        let network: Option<&Arc<Adapter>> = self.base.as_ref().map(|stored| &stored.adapter);
        let mut fitted = fit(&self.data(), &mapped, network, self.seed, run)?;

        // The fitted adapter inherits the base's training data.
        if let Some(base) = &self.base {
            let record = &mut fitted.record;
            record.rooms.extend(base.record.rooms.iter().cloned());
            record
                .calibrated_on
                .extend(base.record.calibrated_on.iter().cloned());
        }

        Ok(fitted)
    }

    /// Publishes the fitted adapter.
    ///
    /// # Errors
    /// [`Error::Taken`] if the name was taken meanwhile, [`Error::Store`] if the store cannot be
    /// written.
    pub async fn publish(&self, store: &Store, fitted: &Fitted) -> Result<Published, Error> {
        let room_fit = RoomFit {
            room: self.stored.room.id().clone(),
            room_revision: self.stored.revision,
            base: self.base.as_ref().map(|stored| BaseAdapter {
                name: stored.name.clone(),
                revision: stored.revision,
            }),
            rules: fitted.rules.clone(),
        };

        // The fit takes minutes, and the name may have been taken meanwhile.
        check_name(store, &self.name, self.stored.room.id()).await?;

        let features = self.features.rows();
        Ok(store
            .publish_fitted(&self.name, fitted, &room_fit, features)
            .await?)
    }
}

fn check_base(base: &StoredAdapter, room: &str) -> Result<(), Error> {
    let has_seen = base
        .record
        .rooms
        .iter()
        .any(|(name, _)| name.as_str() == room);

    if has_seen || base.room_fit.is_some() {
        return Err(Error::Base {
            base: base.name.clone(),
            room: room.to_owned(),
        });
    }
    Ok(())
}

/// Checks, before the fit starts, that the name is valid and not taken by an adapter that was not
/// fitted to this room.
async fn check_name(store: &Store, name: &str, room: &RoomId) -> Result<(), Error> {
    if !is_plain_name(name) {
        return Err(Error::Name {
            name: name.to_owned(),
        });
    }

    let known = store.adapter_names().await?;
    if known.iter().any(|known| known == name) {
        let newest = store.load_adapter(name, None).await?;
        let is_of_this_room = newest.room_fit.is_some_and(|fit| fit.room == *room);
        if !is_of_this_room {
            return Err(Error::Taken {
                name: name.to_owned(),
                room: room.to_string(),
            });
        }
    }

    Ok(())
}
