//! Sets and rolls back defaults, and removes rooms, adapters and revisions.

use prost::Message;

use super::super::auth::RoomScope;
use super::super::caller::Requester;
use super::super::snapshot::Snapshot;
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, named, named_whole};
use super::recent::Identity;
use seese3_client::proto::v1 as pb;
use seese3_store::{Choice, Defaults, Kind, ResourceName};

impl Handlers {
    pub(super) async fn set(
        &self,
        caller: Requester,
        request: pb::SetDefaultRequest,
    ) -> Result<pb::SetDefaultResponse, Error> {
        use pb::set_default_request::Default as Wire;

        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "SetDefault", &content);

        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::SetDefaultRequest {
            name,
            default,
            request_id: _,
            validate_only,
        } = request;

        let resource: ResourceName = name
            .parse()
            .map_err(|error| Error::invalid("name", error))?;
        check_right(&caller, &resource)?;
        if resource.revision.is_some() {
            let problem = "must not name a revision; give it as `revision`";
            return Err(Error::invalid("name", problem));
        }

        let choice = match default {
            None => Choice::Nothing(resource),
            Some(Wire::Revision(revision)) => Choice::Revision(resource.at(revision)),
            Some(Wire::Adapter(adapter)) => {
                if resource.kind != Kind::Room {
                    let problem = "is only for rooms";
                    return Err(Error::invalid("adapter", problem));
                }
                let adapter = named_whole("adapter", &adapter, Kind::Adapter)?.name;
                let snapshot = self.reloaded(&caller).await?;
                check_default_adapter(&snapshot, &resource.name, &adapter)?;
                Choice::Adapter {
                    room: resource.name,
                    adapter,
                }
            }
        };

        let changes = self.changes()?.clone();
        if validate_only {
            let store = changes.store.clone();
            let check = async move {
                store.check_choice(&choice).await?;
                Ok(store.defaults().await?)
            };
            let defaults = changes.validated(&caller.id, check).await?;
            let defaults = defaults_to_wire(&defaults, caller.scope());
            return Ok(pb::SetDefaultResponse { defaults });
        }

        let store = changes.store.clone();
        let change = async move { Ok(store.choose(&choice).await?) };
        let answer = move |defaults: Defaults| pb::SetDefaultResponse {
            defaults: defaults_to_wire(&defaults, caller.scope()),
        };
        changes.once(identity, change, answer).await
    }

    pub(super) async fn roll_back(
        &self,
        caller: Requester,
        request: pb::RollBackDefaultRequest,
    ) -> Result<pb::RollBackDefaultResponse, Error> {
        // The last change may concern any room.
        if caller.scope().is_some_and(|scope| !scope.is_all()) {
            return Err(Error::OutOfScope {
                what: "the defaults of all rooms",
            });
        }

        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "RollBackDefault", &content);
        let changes = self.changes()?.clone();
        let store = changes.store.clone();
        let change = async move { Ok(store.take_back_choice().await?) };
        let answer = |defaults: Defaults| pb::RollBackDefaultResponse {
            defaults: defaults_to_wire(&defaults, None),
        };
        changes.once(identity, change, answer).await
    }

    pub(super) async fn delete_room_named(
        &self,
        caller: Requester,
        request: pb::DeleteRoomRequest,
    ) -> Result<pb::DeleteRoomResponse, Error> {
        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "DeleteRoom", &content);
        let resource = named("name", &request.name, Kind::Room)?;
        check_right(&caller, &resource)?;

        let answer = |revisions| pb::DeleteRoomResponse { revisions };
        let right = std::future::ready(Ok(()));
        self.delete(identity, resource, request.validate_only, right, answer)
            .await
    }

    pub(super) async fn delete_adapter_named(
        &self,
        caller: Requester,
        request: pb::DeleteAdapterRequest,
    ) -> Result<pb::DeleteAdapterResponse, Error> {
        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "DeleteAdapter", &content);
        let resource = named("name", &request.name, Kind::Adapter)?;
        let store = self.changes()?.store.clone();
        let adapter = resource.clone();
        let right = async move {
            let Err(error) = check_right(&caller, &adapter) else {
                return Ok(());
            };
            // A caller may delete the adapters of its own rooms. A damaged one of another room is
            // answered like a missing one.
            let owner = store.owner_of(&adapter.name).await.ok().flatten();
            let room = owner.map(ResourceName::room);
            match room.map(|room| check_right(&caller, &room)) {
                Some(Ok(())) => Ok(()),
                _ => Err(error),
            }
        };

        let answer = |revisions| pb::DeleteAdapterResponse { revisions };
        self.delete(identity, resource, request.validate_only, right, answer)
            .await
    }

    /// Deletes a room or an adapter. `right` checks the caller's right when the change has its turn,
    /// so that no other change comes between.
    async fn delete<A: Message + Default + 'static>(
        &self,
        identity: Identity,
        resource: ResourceName,
        validate_only: bool,
        right: impl Future<Output = Result<(), Error>> + Send + 'static,
        answer: impl Fn(Vec<u64>) -> A + Send + 'static,
    ) -> Result<A, Error> {
        let changes = self.changes()?.clone();
        let store = changes.store.clone();
        if validate_only {
            let check = async move {
                right.await?;
                Ok(store.check_removable(&resource).await?.revisions)
            };
            return Ok(answer(changes.validated(&identity.charged, check).await?));
        }

        let change = async move {
            right.await?;
            Ok(store.remove(&resource).await?.revisions)
        };
        changes.once(identity, change, answer).await
    }
}

/// Checks that the caller sees an adapter and that it can serve a room.
///
/// # Errors
/// [`Error::NotFound`] if the adapter is not among those that the caller sees, whether it exists or
/// not; [`Error::Invalid`] if it does not serve the room.
fn check_default_adapter(snapshot: &Snapshot, room: &str, adapter: &str) -> Result<(), Error> {
    snapshot.adapter(adapter)?;
    let room = snapshot.room(room).map_err(|error| error.named("name"))?;
    if room
        .adapters()
        .iter()
        .any(|serving| serving.name == adapter)
    {
        return Ok(());
    }

    let problem = format!(
        "does not serve rooms/{}: it is fitted to another room, or the room has no features of its source",
        room.id
    );
    Err(Error::invalid("adapter", problem))
}

/// Converts the defaults within the caller's scope to the wire type.
fn defaults_to_wire(defaults: &Defaults, scope: Option<&RoomScope>) -> Vec<pb::Default> {
    let is_seen = |resource: &ResourceName| match resource.kind {
        Kind::Room => scope.is_none_or(|scope| scope.contains(&resource.name)),
        Kind::Adapter => scope.is_none_or(RoomScope::is_all),
    };

    defaults
        .chosen()
        .into_iter()
        .filter(is_seen)
        .map(|resource| {
            let adapter = match resource.kind {
                Kind::Room => defaults.adapter(&resource.name),
                Kind::Adapter => None,
            };
            pb::Default {
                revision: defaults.revision(resource.kind, &resource.name),
                adapter: adapter
                    .map(|adapter| ResourceName::adapter(adapter).to_string())
                    .unwrap_or_default(),
                name: resource.to_string(),
            }
        })
        .collect()
}
