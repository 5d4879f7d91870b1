//! Loading a store into a [`Snapshot`], once at the start and again whenever the store has changed.
//!
//! - What did not change is taken over from the snapshot before, so that a reload costs what
//!   changed and no more.
//! - A room or an adapter that cannot be loaded is refused by itself. If an older revision of it is
//!   being served, that goes on.
//! - A revision that is damaged is not tried again, unless that is asked for. One that could not be
//!   read is tried at every look.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::super::RunError;
use super::super::image_encoder::{self, ImageEncoder, ImageEncoders};
use super::super::metrics::Metrics;
use super::super::two_views::TwoViewReader;
use super::content::content;
use super::{Refusal, ServedNavigator, ServedRoom, Snapshot, reader_of};
use crate::encoder;
use crate::store::{self, RoomFit, Store, StoredAdapter, StoredRoom};
use seese3_core::eval::TrainedOn;
use seese3_core::features::FeatureSource;
use seese3_core::fitting::{Localizer, RoomReader};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, RoomId};
use seese3_core::tracking::Map;
use seese3_core::training::RoomData;

/// Why a room, or a room under an adapter, cannot be served.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    #[error(transparent)]
    Store(#[from] store::Error),
    #[error("adapter '{adapter}' does not serve it: {problem}")]
    Navigator {
        adapter: String,
        problem: seese3_core::navigation::Error,
    },
    #[error(
        "adapter '{adapter}' was fitted from revision {revision} of adapter '{base}', which cannot be read: {problem}; \
         publish that again, or fit anew"
    )]
    Base {
        adapter: String,
        base: String,
        revision: u64,
        problem: Box<store::Error>,
    },
    #[error("adapter '{adapter}' does not locate views in it: {problem}")]
    Localizer {
        adapter: String,
        problem: Box<seese3_core::fitting::Error>,
    },
}

impl Problem {
    /// Whether it may be gone at the next look.
    pub(super) fn may_pass(&self) -> bool {
        match self {
            Self::Store(error) => may_pass(error),
            Self::Base { problem, .. } => may_pass(problem),
            Self::Navigator { .. } | Self::Localizer { .. } => false,
        }
    }
}

fn may_pass(error: &store::Error) -> bool {
    matches!(error, store::Error::Io { .. } | store::Error::Absent { .. })
}

/// Whether revisions that were refused before are tried again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    TryAgain,
    LeaveOut,
}

/// Loads the snapshots of one server.
#[derive(Clone)]
pub struct Loader {
    store: Store,
    index: IndexKind,
    encoders: Option<ImageEncoders>,
    two_views: Option<Arc<TwoViewReader>>,
    metrics: Metrics,
}

impl Loader {
    /// A loader of `store`, on a blocking thread. The models of the operator are read now.
    ///
    /// # Errors
    /// [`RunError::Model`] or [`RunError::TwoView`] if a model cannot be used.
    pub async fn open(
        store: Store,
        index: IndexKind,
        encoders: Option<ImageEncoders>,
        metrics: Metrics,
    ) -> Result<Self, RunError> {
        blocking(move || {
            if let Some(encoders) = &encoders {
                image_encoder::check_models(&encoders.models)?;
            }
            let two_views = TwoViewReader::open(encoders.as_ref())?.map(Arc::new);
            Ok(Self {
                store,
                index,
                encoders,
                two_views,
                metrics,
            })
        })
        .await
    }

    /// Loads every room and adapter for the first time. A store without a room is refused unless
    /// rooms can be added to it through this server.
    ///
    /// # Errors
    /// [`RunError::Store`] if the store cannot be listed, [`RunError::NoRoom`] if it has no room,
    /// [`RunError::NoneServed`] if none of its rooms can be served.
    pub async fn first(&self, is_writable: bool) -> Result<Snapshot, RunError> {
        let location = self.store.location().to_owned();
        let snapshot = self
            .load(Arc::new(Snapshot::default()), Refused::TryAgain)
            .await?;

        if !snapshot.rooms.is_empty() {
            if let Some(encoders) = &self.encoders {
                image_encoder::warn_of_unneeded(&encoders.models, &snapshot.adapters);
            }
            return Ok(snapshot);
        }
        match snapshot.refused.rooms.iter().next() {
            None if is_writable => Ok(snapshot),
            None => Err(RunError::NoRoom { location }),
            Some((room, refusal)) => Err(RunError::NoneServed {
                room: room.clone(),
                reason: refusal.reason.clone(),
            }),
        }
    }

    /// Loads what differs from `before`, on a blocking thread.
    ///
    /// # Errors
    /// [`RunError::Store`] if the store cannot be listed. Everything else is refused by itself.
    pub async fn load(
        &self,
        before: Arc<Snapshot>,
        refused: Refused,
    ) -> Result<Snapshot, RunError> {
        // Loading mixes reads with long computation (embedding, indexing). On an async thread it
        // would hold up health checks and requests.
        let loader = self.clone();
        let runtime = tokio::runtime::Handle::current();
        blocking(move || runtime.block_on(loader.load_now(&before, refused))).await
    }

    async fn load_now(&self, before: &Snapshot, refused: Refused) -> Result<Snapshot, RunError> {
        let mut loaded = Snapshot {
            two_views: self.two_views.clone(),
            ..Snapshot::default()
        };

        let defaults = self.store.defaults().await?;
        for (name, revision) in self.store.current_adapters().await? {
            self.add_adapter(&mut loaded, before, refused, name, revision)
                .await;
        }
        self.add_image_encoders(&mut loaded, before);

        for (name, revision) in self.store.current_rooms().await? {
            if let Some(adapter) = defaults.adapter(&name) {
                loaded
                    .default_adapters
                    .insert(name.clone(), adapter.to_owned());
            }
            self.add_room(&mut loaded, before, refused, name, revision)
                .await;
        }

        Ok(loaded)
    }

    /// Adds the current revision of an adapter; if it is refused, the one that was served before.
    async fn add_adapter(
        &self,
        loaded: &mut Snapshot,
        before: &Snapshot,
        refused: Refused,
        name: String,
        revision: u64,
    ) {
        let known = before.adapters.get(&name);
        if let Some(same) = known.filter(|known| known.revision == revision) {
            loaded.adapters.insert(name, same.clone());
            return;
        }

        let refusal = match kept(&before.refused.adapters, &name, revision, refused) {
            Some(refusal) => refusal,
            None => match self.store.load_adapter(&name, Some(revision)).await {
                Ok(stored) => {
                    loaded.adapters.insert(name, Arc::new(stored));
                    return;
                }
                Err(problem) => {
                    let refusal = Refusal::new(revision, &problem.into());
                    log_refusal(
                        "adapter",
                        &name,
                        before.refused.adapters.get(&name),
                        &refusal,
                    );
                    refusal
                }
            },
        };

        if let Some(known) = known {
            loaded.adapters.insert(name.clone(), known.clone());
        }
        loaded.refused.adapters.insert(name, refusal);
    }

    /// Adds the image encoders of all adapters. An adapter whose encoder cannot be used is served
    /// without one: callers may still send features.
    fn add_image_encoders(&self, loaded: &mut Snapshot, before: &Snapshot) {
        let Some(encoders) = &self.encoders else {
            return;
        };

        // Adapters that were trained on features of the same source share one encoder, because
        // loading a model is expensive.
        let mut opened: Vec<(FeatureSource, Option<Arc<ImageEncoder>>)> = Vec::new();
        for (name, adapter) in &before.adapters {
            let encoder = before.image_encoders.get(name).cloned();
            opened.push((adapter.adapter.source().clone(), encoder));
        }

        for (name, adapter) in &loaded.adapters {
            let source = adapter.adapter.source();
            let encoder = match opened.iter().find(|(other, _)| other.is_like(source)) {
                Some((_, encoder)) => encoder.clone(),
                None => {
                    let encoder = opened_for(name, source, encoders)
                        .map(|encoder| Arc::new(encoder.counted_in(self.metrics.clone())));
                    opened.push((source.clone(), encoder.clone()));
                    encoder
                }
            };
            if let Some(encoder) = encoder {
                loaded.image_encoders.insert(name.clone(), encoder);
            }
        }
    }

    /// Adds the current revision of a room; if it is refused, the one that was served before.
    async fn add_room(
        &self,
        loaded: &mut Snapshot,
        before: &Snapshot,
        refused: Refused,
        name: String,
        revision: u64,
    ) {
        let known = before.rooms.get(&name);
        let same = known.filter(|known| known.revision == revision);
        if let Some(same) = same
            && same.was_tried_with(&fitting(&loaded.adapters, same.room.id(), &same.sources))
            && (refused == Refused::LeaveOut || same.refused_adapters.is_empty())
        {
            loaded.rooms.insert(name, same.clone());
            return;
        }

        let refusal = match kept(&before.refused.rooms, &name, revision, refused) {
            Some(refusal) => refusal,
            None => match self.room(&name, revision, &loaded.adapters, same).await {
                Ok(room) => {
                    loaded.rooms.insert(name, Arc::new(room));
                    return;
                }
                Err(problem) => {
                    let refusal = Refusal::new(revision, &problem);
                    log_refusal("room", &name, before.refused.rooms.get(&name), &refusal);
                    refusal
                }
            },
        };

        if let Some(known) = known {
            loaded.rooms.insert(name.clone(), known.clone());
        }
        loaded.refused.rooms.insert(name, refusal);
    }

    /// A room under every adapter that fits it. `before` is the same revision as it was served with
    /// other adapters.
    async fn room(
        &self,
        name: &str,
        revision: u64,
        adapters: &BTreeMap<String, Arc<StoredAdapter>>,
        before: Option<&Arc<ServedRoom>>,
    ) -> Result<ServedRoom, Problem> {
        let stored = self.store.load_room(name, Some(revision)).await?;
        let sources: Vec<FeatureSource> = stored
            .features
            .iter()
            .map(|set| set.source().clone())
            .collect();

        let mut served = ServedRoom {
            room: Arc::new(stored.room.clone()),
            revision,
            created: stored.created.clone(),
            navigators: Vec::new(),
            refused_adapters: BTreeMap::new(),
            tried: Vec::new(),
            sources,
        };

        for adapter in fitting(adapters, served.room.id(), &served.sources) {
            served.tried.push((adapter.name.clone(), adapter.revision));

            // Fitted adapters come first, so that the reader that trackers are to use is known.
            let source = adapter.adapter.source();
            let tracking_reader = reader_of(&served.navigators, source).cloned();

            let known = before.and_then(|before| before.under(&adapter, tracking_reader.as_ref()));
            let navigator = match known {
                Some(known) => Ok(known.clone()),
                None => self
                    .navigator(&stored, &served.room, &adapter, tracking_reader)
                    .await
                    .map(Arc::new),
            };

            match navigator {
                Ok(navigator) => served.navigators.push(navigator),
                Err(problem) => {
                    let refusal = Refusal::new(adapter.revision, &problem);
                    let known = before.and_then(|room| room.refused_adapters.get(&adapter.name));
                    log_refusal("adapter", &adapter.name, known, &refusal);

                    // The revision before goes on serving the room.
                    let older = before.and_then(|room| room.under_any(&adapter.name));
                    served.navigators.extend(older.cloned());
                    served
                        .refused_adapters
                        .insert(adapter.name.clone(), refusal);
                }
            }
        }

        Ok(served)
    }

    /// A room under one adapter. `tracking_reader` gives the anchors of trackers, where an adapter
    /// was fitted to the room.
    async fn navigator(
        &self,
        stored: &StoredRoom,
        room: &Arc<seese3_core::room::Room>,
        adapter: &Arc<StoredAdapter>,
        tracking_reader: Option<Arc<RoomReader>>,
    ) -> Result<ServedNavigator, Problem> {
        let source = adapter.adapter.source();
        let features = stored
            .features
            .iter()
            .find(|set| set.source().is_like(source));
        let features = features.ok_or_else(|| store::Error::UnknownFeatures {
            room: room.id().to_string(),
            name: source.name.clone(),
            known: Vec::new(),
        })?;

        let navigator = Navigator::new(room.clone(), features, adapter.adapter.clone(), self.index)
            .map_err(|problem| Problem::Navigator {
                adapter: adapter.name.clone(),
                problem,
            })?;
        log_audit(&navigator, &adapter.name);

        let navigator = Arc::new(navigator);
        let trained_on = self
            .store
            .trained_on(&adapter.record, room.id(), stored.revision)
            .await?;

        // Rules that were measured on other frames say nothing of these.
        let room_data = RoomData {
            room,
            revision: stored.revision,
            features,
        };
        let reader = match &adapter.room_fit {
            Some(fit) if trained_on == TrainedOn::TheseFrames => {
                Some(Arc::new(self.room_reader(adapter, fit, &room_data).await?))
            }
            _ => None,
        };

        Ok(ServedNavigator {
            map: map(&navigator, tracking_reader.as_ref()),
            content: content(&navigator, tracking_reader.as_deref()),
            trained_on,
            reader,
            tracking_reader,
            room_revision: stored.revision,
            adapter: adapter.clone(),
            navigator,
        })
    }

    /// The reader of a fitted adapter, with the adapter that it began from as a second one.
    async fn room_reader(
        &self,
        adapter: &StoredAdapter,
        fit: &RoomFit,
        data: &RoomData<'_>,
    ) -> Result<RoomReader, Problem> {
        let base = match &fit.base {
            Some(base) => {
                let loaded = self
                    .store
                    .load_adapter(&base.name, Some(base.revision))
                    .await;
                let stored = loaded.map_err(|problem| Problem::Base {
                    adapter: adapter.name.clone(),
                    base: base.name.clone(),
                    revision: base.revision,
                    problem: Box::new(problem),
                })?;
                Some(stored.adapter)
            }
            None => None,
        };

        let mapped: Vec<FrameId> = (0..data.room.frame_count() as u32).map(FrameId).collect();
        let localizer = Localizer::new(data, &mapped, base, Some(adapter.adapter.clone()))
            .map_err(|problem| Problem::Localizer {
                adapter: adapter.name.clone(),
                problem: Box::new(problem),
            })?;

        Ok(RoomReader {
            localizer,
            rules: fit.rules.clone(),
        })
    }
}

/// Runs work on a blocking thread.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, RunError> + Send + 'static,
) -> Result<T, RunError> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| RunError::Loading(error.to_string()))?
}

/// Logs why a revision is refused, unless that has been logged.
fn log_refusal(kind: &str, name: &str, known: Option<&Refusal>, refusal: &Refusal) {
    if known != Some(refusal) {
        let Refusal {
            revision, reason, ..
        } = refusal;
        tracing::error!(kind, name, revision, reason, "a revision cannot be served");
    }
}

/// The refusal of a revision that is not to be tried again.
fn kept(
    before: &BTreeMap<String, Refusal>,
    name: &str,
    revision: u64,
    refused: Refused,
) -> Option<Refusal> {
    before
        .get(name)
        .filter(|refusal| refused == Refused::LeaveOut && refusal.revision == revision)
        .filter(|refusal| !refusal.may_pass)
        .cloned()
}

/// The image encoder of an adapter; none if it is not at hand or cannot be used, which the log
/// says.
fn opened_for(
    adapter: &str,
    source: &FeatureSource,
    encoders: &ImageEncoders,
) -> Option<ImageEncoder> {
    let opened: Result<_, encoder::Error> = image_encoder::open_for(adapter, source, encoders);
    opened.unwrap_or_else(|problem| {
        tracing::error!(adapter, %problem, "the adapter is served without images");
        None
    })
}

/// The adapters that fit a room with features of these sources, in order of preference: those fitted
/// to this room, then those trained in it, then the newest. The first is the room's default where an
/// operator chose none.
fn fitting(
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    room: &RoomId,
    sources: &[FeatureSource],
) -> Vec<Arc<StoredAdapter>> {
    // An adapter fits a room that has features made as its training features were. One that was
    // fitted to a room serves that room alone.
    let fits = |adapter: &&Arc<StoredAdapter>| {
        let has_features = sources
            .iter()
            .any(|source| source.is_like(adapter.adapter.source()));
        let is_of_another = |fit: &RoomFit| fit.room != *room;

        has_features && !adapter.room_fit.as_ref().is_some_and(is_of_another)
    };
    let rank = |adapter: &StoredAdapter| {
        let is_trained_here = adapter.record.rooms.iter().any(|(name, _)| name == room);
        let is_fitted_here = adapter.room_fit.is_some();
        (
            is_fitted_here,
            is_trained_here,
            adapter.created.clone(),
            adapter.name.clone(),
        )
    };

    let mut ranked: Vec<Arc<StoredAdapter>> = adapters.values().filter(fits).cloned().collect();
    ranked.sort_by_key(|adapter| std::cmp::Reverse(rank(adapter)));
    ranked
}

fn log_audit(navigator: &Navigator, adapter: &str) {
    if let Some(audit) = navigator.audit() {
        tracing::info!(
            room = %navigator.room().id(), adapter, frames = audit.frame_count, unreachable = audit.unreachable,
            recall = audit.recall, k = audit.k, queries = audit.queries,
            "approximate index audited against the exact scan"
        );
    }
}

/// The map of all frames of a room; none if the adapter is not calibrated. A room that is too small
/// to track in also gives none, which is logged. Where an adapter was fitted to the room, its reader
/// gives the anchors.
fn map(navigator: &Arc<Navigator>, reader: Option<&Arc<RoomReader>>) -> Option<Arc<Map>> {
    navigator.adapter().error_model()?;
    let frames: Vec<FrameId> = (0..navigator.room().frame_count() as u32)
        .map(FrameId)
        .collect();

    match Map::new(navigator.clone(), &frames) {
        Ok(map) => Some(Arc::new(match reader {
            Some(reader) => map.with_pose_reader(reader.clone()),
            None => map,
        })),
        Err(error) => {
            tracing::warn!(room = %navigator.room().id(), %error, "the room cannot be tracked in");
            None
        }
    }
}
