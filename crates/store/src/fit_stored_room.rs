//! Fitting an adapter to a room of a store, and publishing it there.

use std::sync::Arc;

use seese3_core::adapter::{Adapter, EpochProgress};
use seese3_core::features::Features;
use seese3_core::room::{FrameId, RoomId, is_plain_name};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{self, Fitted, fit};

use crate::{BaseAdapter, Published, RoomFit, Store, StoredAdapter, StoredRoom};

/// Why an adapter cannot be fitted to a stored room.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error(transparent)]
    Store(#[from] crate::Error),
    #[error(transparent)]
    Fitting(#[from] fitting::Error),
    #[error(
        "adapter '{base}' has seen room '{room}' or was itself fitted to a room; begin from one that \
         learned from other rooms alone, or from none"
    )]
    Base { base: String, room: String },
    #[error("{name:?} cannot name an adapter: use 1 to 100 letters, digits, '.', '-' or '_'")]
    Name { name: String },
    #[error("the name '{name}' is taken by an adapter that was not fitted to room '{room}'")]
    Taken { name: String, room: String },
}

/// What is to be fitted.
#[derive(Debug, Clone)]
pub struct Request {
    /// The room, all of whose frames are its map.
    pub room: String,
    /// An adapter that learned from other rooms: its weights are where the fitted one begins.
    pub base: Option<String>,
    /// The set of features; that of the base, or the room's only one, if none is named.
    pub features: Option<String>,
    /// The name of the fitted adapter; ROOM.FEATURES.fitted if none is given.
    pub name: Option<String>,
    /// The seed of the drawn pairs, of the noise and, without a base, of the initial weights.
    pub seed: u64,
}

/// A fit that can begin: everything is read and checked.
#[derive(Debug)]
pub struct Refit {
    stored: StoredRoom,
    features: Features,
    base: Option<StoredAdapter>,
    name: String,
    seed: u64,
}

impl Refit {
    /// Reads what the fit needs.
    ///
    /// # Errors
    /// [`Error::Base`] if the base has seen the room, since it would look better than it is;
    /// [`Error::Name`] or [`Error::Taken`] if the name cannot be published; [`Error::Store`] if the
    /// room, its features or the base cannot be read.
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

    /// The name under which the fitted adapter is published.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The room and the features that are fitted to.
    pub fn data(&self) -> RoomData<'_> {
        RoomData {
            room: &self.stored.room,
            revision: self.stored.revision,
            features: &self.features,
        }
    }

    /// Fits. `progress` hears of every epoch, [`fitting::FITTING_EPOCHS`] in all.
    ///
    /// # Errors
    /// [`Error::Fitting`], as [`fit`].
    pub fn fit(&self, progress: &(dyn Fn(EpochProgress) + Sync)) -> Result<Fitted, Error> {
        let frame_count = self.stored.room.frame_count();
        let mapped: Vec<FrameId> = (0..frame_count as u32).map(FrameId).collect();
        let network: Option<&Arc<Adapter>> = self.base.as_ref().map(|stored| &stored.adapter);
        let mut fitted = fit(&self.data(), &mapped, network, self.seed, progress)?;

        // What the base has seen, the fitted adapter has seen too.
        if let Some(base) = &self.base {
            let record = &mut fitted.record;
            record.rooms.extend(base.record.rooms.iter().cloned());
            record
                .calibrated_on
                .extend(base.record.calibrated_on.iter().cloned());
        }

        Ok(fitted)
    }

    /// Publishes what was fitted.
    ///
    /// # Errors
    /// [`Error::Taken`] if somebody else has taken the name, [`Error::Store`] if it cannot be written.
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

        // The fit took minutes, in which somebody else may have taken the name.
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

/// Refuses, before anything is fitted, a name that cannot be published or that other adapters have.
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
