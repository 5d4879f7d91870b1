//! Operator defaults: the current revision of a room or adapter, and the adapter that serves a room
//! when a request names none.
//!
//! All defaults of a store are in one file, `defaults/000001.json`. A change writes the next number
//! and keeps the earlier files, so that it can be rolled back.

use std::collections::{BTreeMap, BTreeSet};

use object_store::path::Path;
use serde::{Deserialize, Serialize};
use strum::VariantArray;

use super::manifest::{self, SCHEMA};
use super::{ATTEMPTS, Error, Kind, ResourceName, Store, manifest_name};

const FOLDER: &str = "defaults";

/// The defaults set by an operator. Where none is set, the newest revision is used.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Defaults {
    /// Default revisions of rooms, by room name.
    #[serde(default)]
    room_revisions: BTreeMap<String, u64>,
    /// Default revisions of adapters, by adapter name.
    #[serde(default)]
    adapter_revisions: BTreeMap<String, u64>,
    /// Default adapters of rooms, by room name.
    #[serde(default)]
    adapters: BTreeMap<String, String>,
}

/// Content of a defaults file.
#[derive(Debug, Serialize, Deserialize)]
struct Body {
    schema: u64,
    /// The number in the file's name.
    number: u64,
    /// Time of writing, RFC 3339.
    created: String,
    /// After a rollback, the number of the file whose defaults were restored; 0 for no defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    back_to: Option<u64>,
    defaults: Defaults,
}

/// The defaults in effect, where damaged files are skipped.
#[derive(Debug)]
pub struct StandingDefaults {
    /// The defaults of the newest readable file; empty if there is no such file.
    pub defaults: Defaults,
    /// Why the newest file was skipped, if it was.
    pub refused: Option<Error>,
}

/// The defaults before the last change.
struct Before {
    /// The number of the newest file.
    newest: u64,
    /// The number of the file that set these defaults; 0 for none.
    back_to: u64,
    defaults: Defaults,
}

/// A change of the defaults.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Choice {
    /// Sets the default revision. The resource name includes the revision.
    Revision(ResourceName),
    /// Sets the adapter that serves a room when a request names none.
    Adapter {
        /// The name of the room.
        room: String,
        /// The name of the adapter.
        adapter: String,
    },
    /// Clears all defaults of this room or adapter.
    Nothing(ResourceName),
    /// Clears one default.
    Cleared(Cleared),
}

/// A default that is cleared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cleared {
    /// The default revision of a room or an adapter. The resource name has no revision.
    RevisionOf(ResourceName),
    /// The default adapter of a room.
    AdapterOf {
        /// The name of the room.
        room: String,
    },
}

impl Cleared {
    /// The room or adapter.
    pub fn resource(&self) -> ResourceName {
        match self {
            Self::RevisionOf(resource) => resource.clone(),
            Self::AdapterOf { room } => ResourceName::room(room),
        }
    }
}

impl Defaults {
    /// The default revision of a room or adapter, if set.
    pub fn revision(&self, kind: Kind, name: &str) -> Option<u64> {
        self.revisions(kind).get(name).copied()
    }

    /// The default adapter of a room, if set.
    pub fn adapter(&self, room: &str) -> Option<&str> {
        self.adapters.get(room).map(String::as_str)
    }

    /// The rooms and adapters that have a default; rooms first, each sorted by name.
    pub fn chosen(&self) -> Vec<ResourceName> {
        let rooms: BTreeSet<&String> = self
            .room_revisions
            .keys()
            .chain(self.adapters.keys())
            .collect();
        let rooms = rooms.into_iter().map(ResourceName::room);
        let adapters = self.adapter_revisions.keys().map(ResourceName::adapter);
        rooms.chain(adapters).collect()
    }

    /// The rooms whose default adapter this is.
    pub fn rooms_of<'a>(&'a self, adapter: &'a str) -> impl Iterator<Item = &'a str> {
        let is_chosen = move |entry: &(&'a String, &'a String)| entry.1 == adapter;
        let rooms = self.adapters.iter().filter(is_chosen);
        rooms.map(|(room, _)| room.as_str())
    }

    /// Drops the defaults that refer to a removed resource.
    fn forget(&mut self, gone: &ResourceName) {
        let is_gone = |name: &String, revision: u64| {
            *name == gone.name && gone.revision.is_none_or(|gone| gone == revision)
        };
        match gone.kind {
            Kind::Room => {
                self.room_revisions.retain(|name, now| !is_gone(name, *now));
                if gone.revision.is_none() {
                    self.adapters.remove(&gone.name);
                }
            }
            Kind::Adapter => {
                self.adapter_revisions
                    .retain(|name, now| !is_gone(name, *now));
                if gone.revision.is_none() {
                    self.adapters.retain(|_, adapter| *adapter != gone.name);
                }
            }
        }
    }

    /// All resources that the defaults refer to.
    pub(super) fn named(&self) -> Vec<ResourceName> {
        let mut named: Vec<ResourceName> = Vec::new();
        for &kind in Kind::VARIANTS {
            let resource = |(name, revision): (&String, &u64)| ResourceName {
                kind,
                name: name.clone(),
                revision: Some(*revision),
            };
            named.extend(self.revisions(kind).iter().map(resource));
        }
        for (room, adapter) in &self.adapters {
            named.push(ResourceName::room(room));
            named.push(ResourceName::adapter(adapter));
        }

        named
    }

    fn revisions(&self, kind: Kind) -> &BTreeMap<String, u64> {
        match kind {
            Kind::Room => &self.room_revisions,
            Kind::Adapter => &self.adapter_revisions,
        }
    }

    fn with(&self, choice: &Choice) -> Self {
        let mut changed = self.clone();
        let revisions = |defaults: &mut Self, kind, name: &str, revision: Option<u64>| {
            let revisions = match kind {
                Kind::Room => &mut defaults.room_revisions,
                Kind::Adapter => &mut defaults.adapter_revisions,
            };
            match revision {
                Some(revision) => revisions.insert(name.to_owned(), revision),
                None => revisions.remove(name),
            };
        };

        match choice {
            Choice::Revision(resource) => {
                revisions(
                    &mut changed,
                    resource.kind,
                    &resource.name,
                    resource.revision,
                );
            }
            Choice::Adapter { room, adapter } => {
                changed.adapters.insert(room.clone(), adapter.clone());
            }
            Choice::Nothing(resource) => {
                revisions(&mut changed, resource.kind, &resource.name, None);
                if resource.kind == Kind::Room {
                    changed.adapters.remove(&resource.name);
                }
            }
            Choice::Cleared(Cleared::RevisionOf(resource)) => {
                revisions(&mut changed, resource.kind, &resource.name, None);
            }
            Choice::Cleared(Cleared::AdapterOf { room }) => {
                changed.adapters.remove(room);
            }
        }

        changed
    }
}

impl Store {
    /// The current defaults.
    ///
    /// # Errors
    /// [`Error::Damaged`] if their file is truncated or altered, [`Error::Schema`] if a newer
    /// program wrote it, [`Error::Io`] if the store cannot be read.
    pub async fn defaults(&self) -> Result<Defaults, Error> {
        Ok(self.numbered_defaults().await?.1)
    }

    /// The newest readable defaults, and why newer files were skipped.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be read.
    pub async fn standing_defaults(&self) -> Result<StandingDefaults, Error> {
        let mut refused = None;
        let numbers = match self.numbers_of_defaults().await {
            Err(error @ Error::Damaged { .. }) => {
                refused = Some(error);
                Vec::new()
            }
            numbers => numbers?,
        };

        for number in numbers.into_iter().rev() {
            match self.readable_defaults(number).await? {
                Ok(Body { defaults, .. }) => return Ok(StandingDefaults { defaults, refused }),
                Err(error) => {
                    refused.get_or_insert(error);
                }
            }
        }

        let defaults = Defaults::default();
        Ok(StandingDefaults { defaults, refused })
    }

    /// Checks that a change can be made.
    ///
    /// # Errors
    /// [`Error::Unknown`] or [`Error::UnknownRevision`] if the chosen resource is not in the store,
    /// [`Error::Io`] if the store cannot be read.
    pub async fn check_choice(&self, choice: &Choice) -> Result<(), Error> {
        match choice {
            Choice::Revision(resource) => self.check_exists(resource).await,
            Choice::Adapter { room, adapter } => {
                self.check_exists(&ResourceName::room(room)).await?;
                self.check_exists(&ResourceName::adapter(adapter)).await
            }
            Choice::Cleared(cleared) => {
                // A default outlives what it names, so that it can be cleared.
                let defaults = self.defaults().await?;
                if defaults.with(choice) != defaults {
                    return Ok(());
                }
                self.check_exists(&cleared.resource()).await
            }
            Choice::Nothing(_) => Ok(()),
        }
    }

    /// Changes the defaults and returns them. Setting an existing default again writes nothing.
    ///
    /// # Errors
    /// As [`Store::check_choice`] and [`Store::defaults`]; [`Error::Contended`] if other writers
    /// took every number tried.
    pub async fn choose(&self, choice: &Choice) -> Result<Defaults, Error> {
        self.check_choice(choice).await?;

        for _ in 0..ATTEMPTS {
            let (number, defaults) = self.numbered_defaults().await?;
            let changed = defaults.with(choice);
            if changed == defaults || self.write_defaults(number + 1, None, &changed).await? {
                return Ok(changed);
            }
        }

        Err(contended())
    }

    /// Rolls back the last change of the defaults; repeated calls roll back earlier changes.
    /// Restored defaults that refer to removed resources are dropped. A change whose file is
    /// damaged is also rolled back.
    ///
    /// # Errors
    /// [`Error::NothingToTakeBack`] if there is no change to roll back; otherwise as
    /// [`Store::choose`].
    pub async fn take_back_choice(&self) -> Result<Defaults, Error> {
        for _ in 0..ATTEMPTS {
            let Before {
                newest,
                back_to,
                defaults: mut before,
            } = self.before_last_change().await?;

            for resource in before.named() {
                match self.check_exists(&resource).await {
                    Err(Error::Unknown { .. } | Error::UnknownRevision { .. }) => {
                        before.forget(&resource);
                    }
                    exists => exists?,
                }
            }
            if self
                .write_defaults(newest + 1, Some(back_to), &before)
                .await?
            {
                return Ok(before);
            }
        }

        Err(contended())
    }

    /// The defaults before the last change. Unreadable files are skipped.
    async fn before_last_change(&self) -> Result<Before, Error> {
        let numbers = self.numbers_of_defaults().await?;
        let newest = numbers.last().copied().unwrap_or_default();
        let holds = match newest {
            0 => 0,
            _ => match self.readable_defaults(newest).await? {
                Ok(body) => body.back_to.unwrap_or(newest),
                Err(_) => newest,
            },
        };
        if holds == 0 {
            return Err(Error::NothingToTakeBack);
        }

        for number in numbers.into_iter().rev().filter(|number| *number < holds) {
            if let Ok(body) = self.readable_defaults(number).await? {
                return Ok(Before {
                    newest,
                    back_to: body.back_to.unwrap_or(number),
                    defaults: body.defaults,
                });
            }
        }

        Ok(Before {
            newest,
            back_to: 0,
            defaults: Defaults::default(),
        })
    }

    /// The file of this number. The inner error means that this program can never read it (damaged,
    /// or newer schema).
    async fn readable_defaults(&self, number: u64) -> Result<Result<Body, Error>, Error> {
        match self.read_defaults(number).await {
            Err(error @ (Error::Damaged { .. } | Error::Schema { .. })) => Ok(Err(error)),
            read => read.map(Ok),
        }
    }

    /// The current defaults and the number of their file; 0 if no default was ever set.
    async fn numbered_defaults(&self) -> Result<(u64, Defaults), Error> {
        match self.numbers_of_defaults().await?.last() {
            None => Ok((0, Defaults::default())),
            Some(&number) => Ok((number, self.read_defaults(number).await?.defaults)),
        }
    }

    /// The numbers of the defaults files, in ascending order.
    async fn numbers_of_defaults(&self) -> Result<Vec<u64>, Error> {
        let numbers = self.numbered_files(&Path::from(FOLDER)).await?;
        Ok(numbers.present)
    }

    async fn read_defaults(&self, number: u64) -> Result<Body, Error> {
        let path = Path::from(FOLDER).join(manifest_name(number));
        let file = self.shown(&path);
        let body: Body = manifest::decode(&file, &self.read(&path).await?)?;
        if body.number != number {
            let problem = format!("is file number {}: it was moved or copied", body.number);
            return Err(Error::Damaged {
                file,
                problem: problem.into(),
            });
        }

        Ok(body)
    }

    /// Writes the defaults unless the number is taken. Returns whether they were written.
    async fn write_defaults(
        &self,
        number: u64,
        back_to: Option<u64>,
        defaults: &Defaults,
    ) -> Result<bool, Error> {
        let path = Path::from(FOLDER).join(manifest_name(number));
        let body = Body {
            schema: SCHEMA,
            number,
            created: chrono::Utc::now().to_rfc3339(),
            back_to,
            defaults: defaults.clone(),
        };

        self.write_new(&path, manifest::encode(&self.shown(&path), &body)?)
            .await
    }

    /// Checks that a resource is in the store.
    pub(super) async fn check_exists(&self, resource: &ResourceName) -> Result<(), Error> {
        let ResourceName {
            kind,
            name,
            revision,
        } = resource;
        self.published(*kind, name, *revision).await.map(drop)
    }
}

fn contended() -> Error {
    Error::Contended {
        name: FOLDER.to_owned(),
    }
}
