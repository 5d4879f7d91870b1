//! Listing of a store's contents, by revision.

use std::ops::AddAssign;

use strum::VariantArray;
use tokio_stream::StreamExt;

use super::defaults::Defaults;
use super::format::{AdapterBody, RoomBody};
use super::{Error, Kind, ResourceName, Store, folder_of};

/// A room or an adapter with all its revisions.
#[derive(Debug, Clone)]
pub struct Contents {
    /// The name, without a revision.
    pub resource: ResourceName,
    /// The current revision: the operator's default, else the newest.
    pub current: u64,
    /// Whether the current revision is an operator's default; otherwise it is the newest.
    pub is_chosen: bool,
    /// The operator's default adapter for this room.
    pub default_adapter: Option<String>,
    /// All revisions, in ascending order.
    pub revisions: Vec<RevisionContents>,
}

/// One revision, as described by its manifest.
#[derive(Debug, Clone)]
pub struct RevisionContents {
    /// Revision number, from 1.
    pub revision: u64,
    /// The manifest's summary, or the reason why it cannot be read.
    pub manifest: Result<ManifestSummary, String>,
}

/// Summary of a manifest.
#[derive(Debug, Clone)]
pub struct ManifestSummary {
    /// Time of publication, RFC 3339.
    pub created: String,
    /// Total size of the revision's objects, bytes. Revisions may share objects.
    pub bytes: u64,
    /// Short description of the content.
    pub about: String,
}

/// What a room or an adapter takes in the store.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Number of revisions.
    pub revisions: u64,
    /// Size of all files, bytes; those of removed revisions count until they are collected as
    /// garbage.
    pub bytes: u64,
}

impl AddAssign for Usage {
    fn add_assign(&mut self, other: Self) {
        self.revisions += other.revisions;
        self.bytes += other.bytes;
    }
}

impl Store {
    /// What a room or an adapter takes in the store; nothing if it is not there. A revision that
    /// `resource` names is ignored.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn usage(&self, resource: &ResourceName) -> Result<Usage, Error> {
        let folder = folder_of(resource.kind, &resource.name);
        let mut usage = Usage {
            revisions: self.revisions(&folder).await?.present.len() as u64,
            bytes: 0,
        };

        let mut files = self.objects.list(Some(&folder));
        while let Some(file) = files.next().await {
            usage.bytes += file.map_err(|error| self.io(&folder, error))?.size;
        }
        Ok(usage)
    }

    /// The names of all rooms, or adapters, with files in the store, also of those whose revisions
    /// were all removed; sorted.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn names_with_files(&self, kind: Kind) -> Result<Vec<String>, Error> {
        let folders = self.folders(kind).await?;
        Ok(folders.into_iter().map(|(name, _)| name).collect())
    }

    /// All rooms, then all adapters, each sorted by name.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be read, otherwise as [`Store::defaults`]. A damaged
    /// manifest is not an error; it is reported in its revision.
    pub async fn contents(&self) -> Result<Vec<Contents>, Error> {
        let defaults = self.defaults().await?;
        let mut contents = Vec::new();

        for &kind in Kind::VARIANTS {
            for (name, numbers) in self.numbered(kind).await? {
                let resource = ResourceName {
                    kind,
                    name,
                    revision: None,
                };
                contents.push(
                    self.contents_with(resource, numbers.present, &defaults)
                        .await?,
                );
            }
        }

        Ok(contents)
    }

    /// The contents of one room or adapter, limited to one revision if `resource` names one.
    ///
    /// # Errors
    /// As [`Store::contents`]; [`Error::Unknown`] or [`Error::UnknownRevision`] if it is not in the
    /// store.
    pub async fn contents_of(&self, resource: &ResourceName) -> Result<Contents, Error> {
        self.check_exists(resource).await?;
        let folder = folder_of(resource.kind, &resource.name);
        let present = self.revisions(&folder).await?.present;
        let whole = ResourceName {
            revision: None,
            ..resource.clone()
        };
        let mut contents = self
            .contents_with(whole, present, &self.defaults().await?)
            .await?;

        contents.revisions.retain(|held| {
            resource
                .revision
                .is_none_or(|revision| held.revision == revision)
        });
        Ok(contents)
    }

    async fn contents_with(
        &self,
        resource: ResourceName,
        present: Vec<u64>,
        defaults: &Defaults,
    ) -> Result<Contents, Error> {
        let folder = folder_of(resource.kind, &resource.name);
        let chosen = defaults.revision(resource.kind, &resource.name);
        let newest = present.last().copied().unwrap_or_default();
        let mut revisions = Vec::with_capacity(present.len());

        for revision in present {
            let summary = match resource.kind {
                Kind::Room => {
                    let body = self.room_body(&folder, revision).await;
                    body.map(|body| room_summary(&body))
                }
                Kind::Adapter => {
                    let body = self.adapter_body(&folder, revision).await;
                    body.map(|body| adapter_summary(&body))
                }
            };
            let manifest = match summary {
                Ok(summary) => Ok(summary),
                Err(error @ (Error::Damaged { .. } | Error::Schema { .. })) => {
                    Err(error.to_string())
                }
                Err(error) => return Err(error),
            };
            revisions.push(RevisionContents { revision, manifest });
        }

        let default_adapter = match resource.kind {
            Kind::Room => defaults.adapter(&resource.name).map(str::to_owned),
            Kind::Adapter => None,
        };

        Ok(Contents {
            resource,
            current: chosen.unwrap_or(newest),
            is_chosen: chosen.is_some(),
            default_adapter,
            revisions,
        })
    }
}

fn room_summary(body: &RoomBody) -> ManifestSummary {
    let features: Vec<&str> = body
        .features
        .iter()
        .map(|entry| entry.source.name.as_str())
        .collect();
    let features = match features.as_slice() {
        [] => "no features".to_owned(),
        names => names.join(", "),
    };

    ManifestSummary {
        created: body.created.clone(),
        bytes: body.objects().map(|object| object.bytes).sum(),
        about: format!("{} frames, {features}", body.frame_count),
    }
}

fn adapter_summary(body: &AdapterBody) -> ManifestSummary {
    let features = body.source.name.as_str();
    let about = match &body.fitted_to {
        Some(fit) => format!(
            "for {features}, fitted to rooms/{}/revisions/{}",
            fit.room, fit.room_revision
        ),
        None => format!("for {features}"),
    };
    let about = match &body.training.relational {
        Some(_) => format!("{about}, with a relational reader"),
        None => about,
    };

    ManifestSummary {
        created: body.created.clone(),
        bytes: body.objects().map(|object| object.bytes).sum(),
        about,
    }
}
