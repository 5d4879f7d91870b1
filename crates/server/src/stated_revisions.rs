//! The revisions that requests state instead of the current ones.

use std::collections::BTreeMap;

use super::Error;
use seese3_client::proto::v1 as pb;

/// The rooms and the adapter of a request, with the revisions that it states.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StatedRevisions {
    /// The rooms that the request names; empty for all.
    pub rooms: Vec<String>,
    /// The stated revisions of rooms, by name.
    pub room_revisions: BTreeMap<String, u64>,
    /// The request's field of the revisions of rooms.
    pub room_field: &'static str,
    /// The adapter, if its revision is stated.
    pub adapter: Option<(String, u64)>,
}

impl StatedRevisions {
    /// Whether the request states no revision.
    pub fn is_empty(&self) -> bool {
        self.room_revisions.is_empty() && self.adapter.is_none()
    }

    /// The revisions of a request with at most one room.
    ///
    /// # Errors
    /// [`Error::Invalid`] if a revision is stated without its name.
    fn of(
        (room, room_revision): (&str, Option<u64>),
        (adapter, adapter_revision): (&str, Option<u64>),
    ) -> Result<Self, Error> {
        let stated = room_revision.map(|revision| (room.to_owned(), revision));
        if stated.is_some() && room.is_empty() {
            return Err(Error::invalid("room_revision", "needs room"));
        }

        Ok(Self {
            rooms: Some(room.to_owned())
                .filter(|room| !room.is_empty())
                .into_iter()
                .collect(),
            room_revisions: stated.into_iter().collect(),
            room_field: "room_revision",
            adapter: adapter_of(adapter, adapter_revision)?,
        })
    }

    /// The revisions of a request with a list of rooms.
    ///
    /// # Errors
    /// [`Error::Invalid`] if a revision is stated of a room that the request does not name, or of
    /// an adapter without its name.
    fn of_several(
        rooms: &[String],
        revisions: impl IntoIterator<Item = (String, u64)>,
        (adapter, adapter_revision): (&str, Option<u64>),
    ) -> Result<Self, Error> {
        let room_revisions: BTreeMap<String, u64> = revisions.into_iter().collect();
        let unnamed = room_revisions
            .keys()
            .find(|room| !rooms.is_empty() && !rooms.contains(room));
        if let Some(room) = unnamed {
            let problem = format!("states a revision of '{room}', which the request does not name");
            return Err(Error::invalid("room_revisions", problem));
        }

        Ok(Self {
            rooms: rooms.to_vec(),
            room_revisions,
            room_field: "room_revisions",
            adapter: adapter_of(adapter, adapter_revision)?,
        })
    }

    /// Adds the revisions of another request of a batch.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the requests state different revisions of a room or an adapter.
    fn add(&mut self, other: Self) -> Result<(), Error> {
        let clash = |what: &str, name: &str| {
            let problem =
                format!("state two revisions of {what} '{name}'; send them in different batches");
            Error::invalid("requests", problem)
        };
        for (room, revision) in other.room_revisions {
            let known = *self.room_revisions.entry(room.clone()).or_insert(revision);
            if known != revision {
                return Err(clash("room", &room));
            }
        }
        match (&self.adapter, other.adapter) {
            (Some(known), Some(adapter)) if known.0 != adapter.0 => {
                let problem = format!(
                    "state revisions of the adapters '{}' and '{}'; send them in different batches",
                    known.0, adapter.0
                );
                return Err(Error::invalid("requests", problem));
            }
            (Some(known), Some(adapter)) if *known != adapter => {
                return Err(clash("adapter", &adapter.0));
            }
            (None, adapter @ Some(_)) => self.adapter = adapter,
            _ => {}
        }
        for room in other.rooms {
            if !self.rooms.contains(&room) {
                self.rooms.push(room);
            }
        }
        Ok(())
    }
}

fn adapter_of(adapter: &str, revision: Option<u64>) -> Result<Option<(String, u64)>, Error> {
    match revision {
        Some(_) if adapter.is_empty() => Err(Error::invalid("adapter_revision", "needs adapter")),
        revision => Ok(revision.map(|revision| (adapter.to_owned(), revision))),
    }
}

/// A request that may state revisions.
pub trait StatesRevisions {
    /// The revisions that the request states.
    ///
    /// # Errors
    /// [`Error::Invalid`] if they do not fit the names of the request.
    fn stated_revisions(&self) -> Result<StatedRevisions, Error>;
}

/// Implements [`StatesRevisions`] for requests with the fields `room`, `room_revision`, `adapter`
/// and `adapter_revision`.
macro_rules! of_one_room {
    ($($request:ty),*) => {$(
        impl StatesRevisions for $request {
            fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
                StatedRevisions::of(
                    (&self.room, self.room_revision),
                    (&self.adapter, self.adapter_revision),
                )
            }
        }
    )*};
}

of_one_room!(
    pb::NavigateRequest,
    pb::PlanRouteRequest,
    pb::EstimateMotionRequest,
    pb::EncodeRequest,
    pb::EvaluateRequest,
    pb::ListPairsRequest,
    pb::ScorePredictionsRequest
);

impl StatesRevisions for pb::ListFramesRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        StatedRevisions::of((&self.room, self.room_revision), ("", None))
    }
}

impl StatesRevisions for pb::GetRoomRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        StatedRevisions::of((&self.room, self.room_revision), ("", None))
    }
}

impl StatesRevisions for pb::GetAdapterRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        StatedRevisions::of(("", None), (&self.adapter, self.adapter_revision))
    }
}

impl StatesRevisions for pb::LocalizeRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        StatedRevisions::of_several(
            &self.rooms,
            self.room_revisions.clone(),
            (&self.adapter, self.adapter_revision),
        )
    }
}

impl StatesRevisions for pb::RelocalizeRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        StatedRevisions::of_several(
            &self.rooms,
            self.room_revisions.clone(),
            (&self.adapter, self.adapter_revision),
        )
    }
}

impl StatesRevisions for pb::TrackConfig {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        let mut rooms = self.rooms.clone();
        if !self.room.is_empty() {
            rooms.push(self.room.clone());
        }
        StatedRevisions::of_several(
            &rooms,
            self.room_revisions.clone(),
            (&self.adapter, self.adapter_revision),
        )
    }
}

impl StatesRevisions for pb::BatchNavigateRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        of_batch(&self.requests)
    }
}

impl StatesRevisions for pb::BatchLocalizeRequest {
    fn stated_revisions(&self) -> Result<StatedRevisions, Error> {
        of_batch(&self.requests)
    }
}

/// The revisions that the requests of a batch state. `adapter` is the name of a request's adapter.
///
/// # Errors
/// [`Error::Invalid`] if a request states invalid revisions, or two requests disagree.
fn of_batch<R: StatesRevisions>(requests: &[R]) -> Result<StatedRevisions, Error> {
    let mut all = StatedRevisions {
        room_field: "requests",
        ..StatedRevisions::default()
    };
    let mut each = Vec::new();
    for (position, request) in requests.iter().enumerate() {
        let stated = request.stated_revisions();
        let stated = stated.map_err(|error| error.within(&format!("requests[{position}]")))?;
        if !stated.is_empty() {
            all.add(stated.clone())?;
        }
        each.push(stated);
    }

    // A request without a revision would be answered from that of another one.
    let is_pinned = |stated: &StatedRevisions| {
        let names = |room: &String| stated.rooms.is_empty() || stated.rooms.contains(room);
        let mut rooms = all.room_revisions.iter().filter(|(room, _)| names(room));
        let has_rooms =
            rooms.all(|(room, revision)| stated.room_revisions.get(room) == Some(revision));
        has_rooms && all.adapter == stated.adapter
    };
    if !all.is_empty() && !each.iter().all(is_pinned) {
        return Err(Error::invalid(
            "requests",
            "state a revision of a room or an adapter that another request does not state; send them in \
             different batches",
        ));
    }

    // No names stand for all rooms.
    let mut stating = each.iter().filter(|stated| !stated.is_empty());
    if stating.any(|stated| stated.rooms.is_empty()) {
        all.rooms.clear();
    }
    Ok(all)
}
