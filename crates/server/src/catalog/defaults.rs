//! Sets and clears defaults, and removes rooms, adapters and revisions.

use prost::Message;

use super::super::auth::RoomScope;
use super::super::caller::Requester;
use super::super::snapshot::Snapshot;
use super::super::{Error, Handlers};
use super::changes::{check_right, identity, resource};
use super::recent::Identity;
use seese3_client::proto::v1 as pb;
use seese3_store::{Choice, Cleared, Defaults, Kind, ResourceName};

impl Handlers {
    pub(super) async fn listed_defaults(
        &self,
        caller: &Requester,
    ) -> Result<pb::ListDefaultsResponse, Error> {
        let defaults = self.store.defaults().await?;
        Ok(pb::ListDefaultsResponse {
            defaults: defaults_to_wire(&defaults, caller.scope()),
        })
    }

    pub(super) async fn set(
        &self,
        caller: Requester,
        request: pb::SetDefaultRequest,
    ) -> Result<pb::SetDefaultResponse, Error> {
        use pb::catalog_default::Default as Wire;

        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "SetDefault", &content);

        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::SetDefaultRequest {
            default,
            request_id: _,
            validate_only,
        } = request;

        let required = || Error::invalid("default", "is required");
        let choice = match default
            .and_then(|default| default.default)
            .ok_or_else(required)?
        {
            Wire::RoomAdapter(pb::RoomAdapter { room, adapter }) => {
                check_right(&caller, &ResourceName::room(&room))?;
                let snapshot = self.reloaded(&caller).await?;
                check_default_adapter(&snapshot, &room, &adapter)
                    .map_err(|error| error.within("default.room_adapter"))?;
                Choice::Adapter { room, adapter }
            }
            Wire::RoomRevision(of) => revision_of(Kind::Room, of, &caller)?,
            Wire::AdapterRevision(of) => revision_of(Kind::Adapter, of, &caller)?,
        };

        let answer = |defaults| pb::SetDefaultResponse { defaults };
        self.change_default(caller, identity, choice, validate_only, answer)
            .await
            .map_err(|error| error.within("default"))
    }

    pub(super) async fn clear(
        &self,
        caller: Requester,
        request: pb::ClearDefaultRequest,
    ) -> Result<pb::ClearDefaultResponse, Error> {
        use pb::clear_default_request::Default as Wire;

        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "ClearDefault", &content);

        // Destructured with no `..`, so that a new field breaks the build here.
        let pb::ClearDefaultRequest {
            default,
            request_id: _,
            validate_only,
        } = request;

        let required = || Error::invalid("default", "is required");
        let (field, cleared) = match default.ok_or_else(required)? {
            Wire::AdapterOfRoom(room) => ("adapter_of_room", Cleared::AdapterOf { room }),
            Wire::RevisionOfRoom(room) => (
                "revision_of_room",
                Cleared::RevisionOf(ResourceName::room(room)),
            ),
            Wire::RevisionOfAdapter(adapter) => (
                "revision_of_adapter",
                Cleared::RevisionOf(ResourceName::adapter(adapter)),
            ),
        };
        let named = cleared.resource();
        resource(named.kind, &named.name, None).map_err(|error| error.named(field))?;
        check_right(&caller, &named)?;

        let answer = |defaults| pb::ClearDefaultResponse { defaults };
        let choice = Choice::Cleared(cleared);
        let changed = self.change_default(caller, identity, choice, validate_only, answer);
        changed.await.map_err(|error| error.of_name(field))
    }

    /// Makes a change of the defaults, or only checks it.
    async fn change_default<A: Message + Default + 'static>(
        &self,
        caller: Requester,
        identity: Identity,
        choice: Choice,
        validate_only: bool,
        answer: impl FnOnce(Vec<pb::CatalogDefault>) -> A + Send + 'static,
    ) -> Result<A, Error> {
        let changes = self.changes()?.clone();
        let store = changes.store.clone();
        if validate_only {
            let check = async move {
                store.check_choice(&choice).await?;
                Ok(store.defaults().await?)
            };
            let defaults = changes.validated(&caller.id, check).await?;
            return Ok(answer(defaults_to_wire(&defaults, caller.scope())));
        }

        let change = async move { Ok(store.choose(&choice).await?) };
        let answer = move |defaults: Defaults| answer(defaults_to_wire(&defaults, caller.scope()));
        changes.once(identity, change, answer).await
    }

    pub(super) async fn delete_room_named(
        &self,
        caller: Requester,
        request: pb::DeleteRoomRequest,
    ) -> Result<pb::DeleteRoomResponse, Error> {
        let content = request.encode_to_vec();
        let identity = identity(&caller, &request.request_id, "DeleteRoom", &content);
        let resource = resource(Kind::Room, &request.room, request.room_revision)?;
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
        let resource = resource(Kind::Adapter, &request.adapter, request.adapter_revision)?;
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

    /// Deletes a room or an adapter. `right` checks the caller's right when the change has its
    /// turn, so that no other change comes between.
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
    let room = snapshot.room(room)?;
    if room
        .adapters()
        .iter()
        .any(|serving| serving.name == adapter)
    {
        return Ok(());
    }

    let problem = format!(
        "does not serve room '{}': it is fitted to another room, or the room has no features of its source",
        room.id
    );
    Err(Error::invalid("adapter", problem))
}

/// The change that sets the default revision of a room or an adapter.
fn revision_of(kind: Kind, of: pb::Revision, caller: &Requester) -> Result<Choice, Error> {
    let pb::Revision { name, revision } = of;
    if name.is_empty() || revision == 0 {
        let problem = "name and revision are required";
        return Err(Error::invalid(format!("default.{kind}_revision"), problem));
    }

    let resource = resource(kind, &name, Some(revision))?;
    check_right(caller, &resource)?;
    Ok(Choice::Revision(resource))
}

/// Converts the defaults within the caller's scope to the wire type.
fn defaults_to_wire(defaults: &Defaults, scope: Option<&RoomScope>) -> Vec<pb::CatalogDefault> {
    use pb::catalog_default::Default as Wire;

    let is_seen = |resource: &ResourceName| match resource.kind {
        Kind::Room => scope.is_none_or(|scope| scope.contains(&resource.name)),
        Kind::Adapter => scope.is_none_or(RoomScope::is_all),
    };

    let mut wire = Vec::new();
    for resource in defaults.chosen().into_iter().filter(is_seen) {
        let name = resource.name;
        if let Some(revision) = defaults.revision(resource.kind, &name) {
            let of = pb::Revision {
                name: name.clone(),
                revision,
            };
            wire.push(match resource.kind {
                Kind::Room => Wire::RoomRevision(of),
                Kind::Adapter => Wire::AdapterRevision(of),
            });
        }
        if resource.kind == Kind::Room
            && let Some(adapter) = defaults.adapter(&name)
        {
            wire.push(Wire::RoomAdapter(pb::RoomAdapter {
                room: name.clone(),
                adapter: adapter.to_owned(),
            }));
        }
    }

    wire.into_iter()
        .map(|default| pb::CatalogDefault {
            default: Some(default),
        })
        .collect()
}
