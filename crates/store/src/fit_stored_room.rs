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
    #[error(
        "a caller without access to all rooms can only name the adapter '{room}.NAME', where NAME \
         has no dot, or give no name"
    )]
    OtherRooms { room: String },
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
    /// Name of the fitted adapter. If `None`, `ROOM.FEATURES.fitted`, or `ROOM.FEATURES-fitted` if
    /// another adapter has that name.
    pub name: Option<String>,
    /// Whether only names that are reserved for the room's adapters, and the default name, are
    /// accepted.
    pub own_names_only: bool,
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
    /// Whether the caller gave no name.
    is_default_name: bool,
    seed: u64,
}

impl Refit {
    /// Loads and checks the inputs of a fit.
    ///
    /// # Errors
    /// [`Error::Base`] if the base was trained on the room, since its errors there would be
    /// underestimated, or was fitted to any room; [`Error::Name`], [`Error::Taken`] or
    /// [`Error::OtherRooms`] if the name cannot be published; [`Error::Store`] if the room, its
    /// features or the base cannot be read.
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

        let room = &request.room;
        let default_name = format!("{room}.{}.fitted", features.source().name);
        if let Some(name) = &request.name
            && request.own_names_only
            && *name != default_name
            && !is_own_name(name, room)
        {
            return Err(Error::OtherRooms { room: request.room });
        }

        let mut refit = Self {
            stored,
            features,
            base,
            is_default_name: request.name.is_none(),
            name: request.name.unwrap_or(default_name),
            seed: request.seed,
        };
        refit.choose_name(store).await?;
        Ok(refit)
    }

    /// Checks the name. Replaces the default name if another adapter has it.
    async fn choose_name(&mut self, store: &Store) -> Result<(), Error> {
        let room = self.stored.room.id();
        if !self.is_default_name {
            return check_name(store, &self.name, room).await;
        }

        // Room `a` with features `b.f` has the same default name as room `a.b` with features `f`.
        let features = self.features.source().name.replace('.', "-");
        let reserved = format!("{room}.{features}-fitted");
        let owner = store.owner_of(&reserved).await;
        let is_ours = owner.is_ok_and(|owner| owner.as_deref() == Some(room.as_str()));
        match check_name(store, &self.name, room).await {
            Ok(()) if !is_ours => Ok(()),
            Ok(()) | Err(Error::Taken { .. }) => {
                check_name(store, &reserved, room).await?;
                self.name = reserved;
                Ok(())
            }
            Err(error) => Err(error),
        }
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

    /// Publishes the fitted adapter under [`Refit::name`], which may have changed.
    ///
    /// # Errors
    /// [`Error::Taken`] if the name was taken meanwhile, [`Error::Store`] if the store cannot be
    /// written.
    pub async fn publish(&mut self, store: &Store, fitted: &Fitted) -> Result<Published, Error> {
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
        self.choose_name(store).await?;

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

/// Whether an adapter's name is `ROOM.NAME` without a further dot. A name with one could belong to
/// a room with a dotted name.
fn is_own_name(adapter: &str, room: &str) -> bool {
    let rest = adapter.strip_prefix(room);
    let rest = rest.and_then(|rest| rest.strip_prefix('.'));
    rest.is_some_and(|rest| !rest.is_empty() && !rest.contains('.'))
}

/// Checks, before the fit starts, that the name is valid and not taken by an adapter that was not
/// fitted to this room.
async fn check_name(store: &Store, name: &str, room: &RoomId) -> Result<(), Error> {
    if !is_plain_name(name) {
        return Err(Error::Name {
            name: name.to_owned(),
        });
    }
    let taken = || Error::Taken {
        name: name.to_owned(),
        room: room.to_string(),
    };

    let newest = match store.newest_adapter(name).await {
        Ok(newest) => newest,
        // What it was is unknown, so it may be another room's.
        Err(crate::Error::Damaged { .. } | crate::Error::Schema { .. }) => return Err(taken()),
        Err(error) => return Err(error.into()),
    };
    match newest.map(|body| body.fitted_to.map(|fit| fit.room)) {
        None => Ok(()),
        Some(Some(fitted_to)) if fitted_to == room.as_str() => Ok(()),
        Some(_) => Err(taken()),
    }
}
