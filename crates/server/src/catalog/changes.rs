//! Common steps of all catalog changes: authorization, stored responses for retries, one change at
//! a time, and a reload of the store afterwards.

use std::collections::BTreeSet;
use std::future::Future;
use std::sync::{self, Arc, PoisonError};

use prost::Message;
use sha2::{Digest, Sha256};
use tokio::sync::{Mutex, watch};
use tracing::Instrument;

use super::super::caller::{CallerId, Requester};
use super::super::metrics::Metrics;
use super::super::reload::ReloadHandle;
use super::super::shares::{Exhausted, Share, Shares};
use super::super::snapshot::Snapshot;
use super::super::status::{Full, Missing};
use super::super::{Config, Error, Handlers, Phase};
use super::recent::{Identity, Recent};
use seese3_client::proto::v1 as pb;
use seese3_core::room::is_plain_name;
use seese3_store::fit_stored_room;
use seese3_store::{AddedPart, Kind, Published, Quota, Quotas, ResourceName, Scope, Store};

/// Maximum number of queued or running changes.
const MOST_WAITING: usize = 64;

/// State shared by all catalog changes.
pub struct Changes {
    pub store: Store,
    /// What is served.
    phase: watch::Receiver<Phase>,
    /// What may be stored of each room.
    quota: Quota,
    reload: ReloadHandle,
    recent: Arc<Mutex<Recent>>,
    /// Places of queued and running changes.
    waiting: Arc<Shares>,
    /// Memory of all uploads, bytes.
    uploads: Arc<Shares>,
    /// Callers with a fit that is queued or runs.
    fits: Arc<sync::Mutex<BTreeSet<CallerId>>>,
    metrics: Metrics,
}

impl Changes {
    pub fn new(
        store: Store,
        phase: watch::Receiver<Phase>,
        reload: ReloadHandle,
        config: &Config,
    ) -> Self {
        Self {
            store,
            phase,
            quota: config.room_quota,
            reload,
            recent: Arc::default(),
            waiting: Shares::new(MOST_WAITING),
            uploads: Shares::new(config.upload_bytes),
            fits: Arc::default(),
            metrics: config.metrics.clone(),
        }
    }

    /// The store, whose publications are checked against the caller's quotas.
    pub fn store_for(&self, caller: &Requester) -> Store {
        let scope = caller.scope().filter(|scope| !scope.is_all()).cloned();
        self.store.with_quotas(Quotas {
            room: self.quota,
            caller: caller.quota(),
            scope: scope.map(|scope| Arc::new(move |room: &str| scope.contains(room)) as Scope),
        })
    }

    /// Makes a change at most once per request id. Waits for its turn; returns the stored response
    /// if this change was made already; otherwise makes the change, reloads the store, and builds
    /// and stores the response. An admitted change is completed even if the caller disconnects.
    ///
    /// # Errors
    /// The errors of the change; [`Error::Invalid`] if the request id belongs to a different
    /// change, [`Error::Full`] if too many changes are queued.
    pub async fn once<T: Send + 'static, A: Message + Default + 'static>(
        self: &Arc<Self>,
        identity: Identity,
        change: impl Future<Output = Result<T, Error>> + Send + 'static,
        answer: impl FnOnce(T) -> A + Send + 'static,
    ) -> Result<A, Error> {
        let waiting = self.place(&identity.charged)?;

        let changes = self.clone();
        let made = tokio::spawn(
            async move {
                let _waiting = waiting;

                // Changes queue here without holding a thread.
                let mut recent = changes.recent.lock().await;
                if let Some(answer) = recent.answer(&identity)? {
                    return A::decode(answer).map_err(|_| Error::Internal);
                }

                changes.check_store().await?;
                let made = on_blocking_thread(change).await??;
                changes.reload.now().await;
                let answer = answer(made);
                recent.remember(identity, answer.encode_to_vec());
                Ok(answer)
            }
            .in_current_span(),
        );

        made.await.unwrap_or_else(|error| {
            tracing::error!(%error, "a change panicked");
            Err(Error::Internal)
        })
    }

    /// Runs the checks of a `validate_only` request on a blocking thread, within the caller's share
    /// of queued changes.
    ///
    /// # Errors
    /// The errors of the check; [`Error::Full`] if too many changes are queued.
    pub async fn validated<T: Send + 'static>(
        &self,
        caller: &CallerId,
        check: impl Future<Output = Result<T, Error>> + Send + 'static,
    ) -> Result<T, Error> {
        let _place = self.place(caller)?;
        self.check_store().await?;
        on_blocking_thread(check).await?
    }

    /// Refuses changes of a store that has disappeared, for instance with its disk: a change would
    /// make a new one in its place, without what is served.
    async fn check_store(&self) -> Result<(), Error> {
        let serves = match &*self.phase.borrow() {
            Phase::Serving(snapshot) => {
                !snapshot.rooms().is_empty() || !snapshot.adapters().is_empty()
            }
            _ => false,
        };
        for kind in [Kind::Room, Kind::Adapter] {
            if !serves || self.store.remembers(kind).await? {
                return Ok(());
            }
        }
        Err(Error::Precondition(
            "the store has disappeared: its folder was moved, removed or unmounted; nothing was changed"
                .to_owned(),
        ))
    }

    /// A place among the queued changes.
    fn place(&self, caller: &CallerId) -> Result<Share, Error> {
        let place = self.waiting.take(caller.clone(), 1);
        place.map_err(|limit| {
            self.full(match limit {
                Exhausted::Budget => Full::Changes,
                Exhausted::Share => Full::CallersChanges,
            })
        })
    }

    /// The stored response to the same change, if it was made already.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the request id is too long or belongs to a different change.
    pub async fn answered<A: Message + Default>(
        &self,
        identity: &Identity,
    ) -> Result<Option<A>, Error> {
        let mut recent = self.recent.lock().await;
        let answer = recent.answer(identity)?;
        let decoded = answer.map(A::decode).transpose();
        decoded.map_err(|_| Error::Internal)
    }

    /// Reserves memory for a part of an upload; it is released when the share is dropped.
    ///
    /// # Errors
    /// [`Error::Invalid`] if it exceeds the largest share of one caller, [`Error::Full`] if the
    /// uploads in progress leave too little.
    pub fn upload_memory(&self, caller: &CallerId, bytes: usize) -> Result<Share, Error> {
        if bytes > self.uploads.budget().div_ceil(2) {
            let problem = "exceeds the memory limit of an upload, half of --max-upload-bytes; the operator \
                           sets it";
            return Err(Error::invalid("message", problem));
        }

        let memory = self.uploads.take(caller.clone(), bytes);
        memory.map_err(|limit| {
            self.full(match limit {
                Exhausted::Budget => Full::Uploads,
                Exhausted::Share => Full::CallersUploads,
            })
        })
    }

    /// The place of a caller's fit.
    ///
    /// # Errors
    /// [`Error::Full`] if the caller has a fit that is queued or runs.
    pub fn fit_place(&self, caller: &CallerId) -> Result<FitPlace, Error> {
        let mut fits = self.fits.lock().unwrap_or_else(PoisonError::into_inner);
        if !fits.insert(caller.clone()) {
            return Err(self.full(Full::CallersFits));
        }
        Ok(FitPlace {
            caller: caller.clone(),
            fits: self.fits.clone(),
        })
    }

    fn full(&self, what: Full) -> Error {
        self.metrics.shed(what);
        Error::Full { what }
    }
}

/// The place of a caller's only fit, free again when dropped.
pub struct FitPlace {
    caller: CallerId,
    fits: Arc<sync::Mutex<BTreeSet<CallerId>>>,
}

impl Drop for FitPlace {
    fn drop(&mut self) {
        let mut fits = self.fits.lock().unwrap_or_else(PoisonError::into_inner);
        fits.remove(&self.caller);
    }
}

/// Runs work on a blocking thread, because writing a store mixes file access with hashing.
pub async fn on_blocking_thread<T: Send + 'static>(
    work: impl Future<Output = T> + Send + 'static,
) -> Result<T, Error> {
    let runtime = tokio::runtime::Handle::current();
    let span = tracing::Span::current();
    let done = tokio::task::spawn_blocking(move || span.in_scope(|| runtime.block_on(work)));

    done.await.map_err(|error| {
        tracing::error!(%error, "a change panicked");
        Error::Internal
    })
}

impl Handlers {
    /// The shared state of changes.
    ///
    /// # Errors
    /// [`Error::Precondition`] if this server is read-only, [`Error::Loading`] if it is not
    /// serving, since it would not serve the change.
    pub(super) fn changes(&self) -> Result<&Arc<Changes>, Error> {
        if !matches!(&*self.phase.borrow(), Phase::Serving(_)) {
            return Err(Error::Loading);
        }

        self.changes.as_ref().ok_or_else(|| {
            Error::Precondition(
                "this server is read-only; start it with --writable, or change its store directly"
                    .to_owned(),
            )
        })
    }

    /// The snapshot of the store as it is now, limited to the rooms that the caller may see:
    /// another program may have published an adapter that the caller names.
    ///
    /// # Errors
    /// As [`Handlers::changes`].
    pub(super) async fn reloaded(&self, caller: &Requester) -> Result<Arc<Snapshot>, Error> {
        self.changes()?.reload.now().await;
        self.snapshot_for(caller.scope())
    }

    /// Whether a room is currently served with this revision of an adapter.
    pub(super) fn serves_in(&self, room: &str, adapter: &pb::Revision) -> bool {
        match &*self.phase.borrow() {
            Phase::Serving(snapshot) | Phase::Draining(snapshot) => {
                let served = snapshot.rooms().get(room);
                served.is_some_and(|room| {
                    room.adapters().iter().any(|held| {
                        (&held.name, held.revision) == (&adapter.name, adapter.revision)
                    })
                })
            }
            Phase::Loading | Phase::Stopping => false,
        }
    }

    /// Whether this revision is currently served.
    pub(super) fn serves(&self, kind: Kind, published: &pb::Revision) -> bool {
        let is_served = |snapshot: &Snapshot| match kind {
            Kind::Room => snapshot
                .rooms()
                .get(&published.name)
                .is_some_and(|room| room.summary.revision == published.revision),
            Kind::Adapter => snapshot
                .adapters()
                .get(&published.name)
                .is_some_and(|adapter| adapter.revision == published.revision),
        };

        match &*self.phase.borrow() {
            Phase::Serving(snapshot) | Phase::Draining(snapshot) => is_served(snapshot),
            Phase::Loading | Phase::Stopping => false,
        }
    }
}

/// The identity of a change. `method` distinguishes RPCs with equal content.
pub fn identity(caller: &Requester, request_id: &str, method: &str, content: &[u8]) -> Identity {
    let mut digest = Sha256::new();
    digest.update(method);
    digest.update([0]);
    digest.update(content);

    Identity {
        caller: caller.name().to_owned(),
        charged: caller.id.clone(),
        request_id: request_id.to_owned(),
        content: digest.finalize().into(),
    }
}

/// The room or adapter that a change names, with its revision if one is given.
///
/// # Errors
/// [`Error::Invalid`] if the name is empty or not valid.
pub fn resource(kind: Kind, name: &str, revision: Option<u64>) -> Result<ResourceName, Error> {
    let field = match kind {
        Kind::Room => "room",
        Kind::Adapter => "adapter",
    };
    if name.is_empty() {
        return Err(Error::invalid(field, "is required"));
    }
    if !is_plain_name(name) {
        let problem = format!("{name:?} is no name: use 1 to 100 letters, digits, '.', '-' or '_'");
        return Err(Error::invalid(field, problem));
    }

    Ok(ResourceName {
        kind,
        name: name.to_owned(),
        revision,
    })
}

/// Checks that the caller may change a resource. Adapters affect all rooms, so changing them
/// requires access to all rooms.
///
/// # Errors
/// [`Error::OutOfScope`] if not.
pub fn check_right(caller: &Requester, resource: &ResourceName) -> Result<(), Error> {
    let Some(scope) = caller.scope() else {
        return Ok(());
    };

    match resource.kind {
        Kind::Room if scope.contains(&resource.name) => Ok(()),
        Kind::Room => Err(Error::OutOfScope { what: "this room" }),
        Kind::Adapter if scope.is_all() => Ok(()),
        Kind::Adapter => Err(Error::OutOfScope { what: "adapters" }),
    }
}

/// Converts a published revision to the wire type.
pub fn revision_to_wire(name: &str, published: &Published) -> pb::Revision {
    pb::Revision {
        name: name.to_owned(),
        revision: published.revision,
    }
}

impl From<seese3_store::Error> for Error {
    fn from(error: seese3_store::Error) -> Self {
        use seese3_store::Error as E;

        match &error {
            E::Unknown { kind, name, .. } => Self::NotStored {
                field: (*kind).to_owned(),
                missing: Missing::of(kind, name),
                problem: format!("'{name}' is not in the store"),
            },
            E::UnknownRevision {
                kind,
                name,
                revision,
                ..
            } => Self::no_revision(&format!("{kind}_revision"), name, *revision),
            E::UnknownFeatures { .. } | E::WhichFeatures { .. } | E::Join { .. } => {
                Self::invalid("feature_set", error)
            }
            E::Quota { .. } => Self::Quota {
                problem: error.to_string(),
            },
            E::Exists {
                kind,
                name,
                revision,
            } => Self::Exists {
                field: format!("{kind}.mode"),
                there: Missing::of(kind, name),
                problem: format!(
                    "{kind} '{name}' exists in revision {revision} with other content; send \
                     UPLOAD_MODE_REPLACE for a new revision{}, or another name",
                    match *kind {
                        "room" => ", UPLOAD_MODE_EXTEND to add frames",
                        _ => "",
                    }
                ),
            },
            E::InUse { .. } | E::NothingToTakeBack => Self::Precondition(error.to_string()),
            E::Contended { name } => Self::Conflict {
                name: name.clone(),
                problem: "was changed concurrently by other writers; retry".to_owned(),
            },
            E::FeatureRows { .. } | E::DuplicateFeatures { .. } => {
                Self::invalid("feature_sources", error)
            }
            E::Name { .. } => Self::invalid("name", error),
            E::CannotAdd { part, .. } => {
                let field = match part {
                    AddedPart::Frames => "frames",
                    AddedPart::Features => "feature_sources",
                    AddedPart::Camera => "camera",
                    AddedPart::Keypoints => "keypoints",
                };
                Self::invalid(field, error)
            }
            E::Absent { .. } => Self::Conflict {
                name: "the store".to_owned(),
                problem: "was changed concurrently by another process; retry".to_owned(),
            },
            _ => {
                tracing::error!(%error, "the store could not be changed");
                Self::Precondition(
                    "the store cannot be read or written, or is damaged there; see the server's log"
                        .to_owned(),
                )
            }
        }
    }
}

impl From<fit_stored_room::Error> for Error {
    fn from(error: fit_stored_room::Error) -> Self {
        use fit_stored_room::Error as E;

        match error {
            E::Store(error) => error.into(),
            E::Base { .. } => Self::invalid("base_adapter", error),
            E::Name { .. } | E::Taken { .. } | E::OtherRooms { .. } => {
                Self::invalid("fitted_adapter", error)
            }
            E::Fitting(_) => Self::Precondition(error.to_string()),
        }
    }
}
