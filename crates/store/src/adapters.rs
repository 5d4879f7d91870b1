//! Publishing and loading adapters.

use ndarray::ArrayView2;
use object_store::path::Path;

use super::adapter_files::{
    TWIST_FRAME, UPLOADED_MANIFEST, adapter_file, assembled, check_adapter_files,
};
use super::format::{AdapterBody, FittedEntry, TrainingEntry};
use super::manifest::{self, ObjectRef, SCHEMA};
use super::publication::{Publication, UploadPolicy};
use super::stored_adapter::{RoomFit, StoredAdapter};
use super::{
    ATTEMPTS, Defaults, Error, Kind, Published, Store, folder_of, gone_name, revision_path,
};
use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::room::is_plain_name;
use seese3_robot::fitting::Fitted;

/// Intended use of a published adapter.
enum Purpose<'a> {
    AnyRoom,
    OneRoom(&'a RoomFit),
    Experiment,
}

impl Store {
    /// Publishes an adapter as a new revision. A sample of `features` (n, d), its training
    /// features, is stored as golden inputs together with the adapter's outputs. Publishing the
    /// same content again creates no revision.
    ///
    /// # Errors
    /// [`Error::Name`] if the name is not valid, [`Error::Damaged`] if the features do not fit the
    /// adapter, [`Error::Contended`] if other publishers took every revision number tried,
    /// [`Error::Io`] if the store cannot be written; as [`Store::load_adapter`] if the newest
    /// revision cannot be read.
    pub async fn publish_adapter(
        &self,
        name: &str,
        adapter: &Adapter,
        record: &TrainingRecord,
        features: ArrayView2<'_, f32>,
    ) -> Result<Published, Error> {
        self.publish(name, adapter, record, features, &Purpose::AnyRoom)
            .await
    }

    /// Publishes an adapter of an experiment, like [`Store::publish_adapter`]. It is used when
    /// requested by name, and as a default only where no other adapter fits.
    ///
    /// # Errors
    /// As [`Store::publish_adapter`].
    pub async fn publish_experiment(
        &self,
        name: &str,
        adapter: &Adapter,
        record: &TrainingRecord,
        features: ArrayView2<'_, f32>,
    ) -> Result<Published, Error> {
        self.publish(name, adapter, record, features, &Purpose::Experiment)
            .await
    }

    /// Publishes an adapter fitted to a room, like [`Store::publish_adapter`].
    ///
    /// # Errors
    /// As [`Store::publish_adapter`].
    pub async fn publish_fitted(
        &self,
        name: &str,
        fitted: &Fitted,
        room_fit: &RoomFit,
        features: ArrayView2<'_, f32>,
    ) -> Result<Published, Error> {
        let Fitted {
            adapter, record, ..
        } = fitted;
        self.publish(name, adapter, record, features, &Purpose::OneRoom(room_fit))
            .await
    }

    async fn publish(
        &self,
        name: &str,
        adapter: &Adapter,
        record: &TrainingRecord,
        features: ArrayView2<'_, f32>,
        purpose: &Purpose<'_>,
    ) -> Result<Published, Error> {
        if !is_plain_name(name) {
            return Err(Error::Name {
                what: "an adapter",
                name: name.to_owned(),
            });
        }

        let room_fit = match purpose {
            Purpose::OneRoom(fit) => Some(*fit),
            Purpose::AnyRoom | Purpose::Experiment => None,
        };
        let bytes = adapter_file(name, adapter, features, room_fit)?;
        let body = AdapterBody {
            schema: SCHEMA,
            source: adapter.source().clone(),
            twist_frame: TWIST_FRAME.to_owned(),
            // σ of the targets is divided by n, not by n − 1.
            deviation_ddof: 0,
            training: TrainingEntry::new(record, adapter),
            fitted_to: room_fit.map(FittedEntry::from),
            experiment: matches!(purpose, Purpose::Experiment),
            // Set by `publish_body`.
            adapter: String::new(),
            revision: 0,
            created: String::new(),
            weights: ObjectRef::default(),
        };
        self.publish_body(name, body, bytes, None).await
    }

    /// Publishes a manifest and its weights under a name. Sets the name, revision, date and weights
    /// reference.
    async fn publish_body(
        &self,
        name: &str,
        body: AdapterBody,
        weights: Vec<u8>,
        policy: Option<UploadPolicy>,
    ) -> Result<Published, Error> {
        let folder = folder_of(Kind::Adapter, name);
        // A refused upload writes nothing.
        if policy == Some(UploadPolicy::Replace) {
            self.check_adapter_upload(name, UploadPolicy::Replace)
                .await?;
        }

        let body = AdapterBody {
            adapter: name.to_owned(),
            ..body
        };
        let publication = Publication::begin(self, body.owner()).await?;

        // Write the weights before the manifest that makes them visible.
        let content = weights;
        let weights = self
            .write_object(
                &publication,
                &folder,
                "weights",
                "safetensors",
                content.clone(),
            )
            .await?;

        // As for rooms: try to create the next revision, and retry if another publisher was faster.
        for _ in 0..ATTEMPTS {
            let numbers = self.revisions(&folder).await?;
            let newest = match numbers.present.last() {
                Some(&revision) => Some(self.adapter_body(&folder, revision).await?),
                None => None,
            };

            let body = AdapterBody {
                revision: numbers.highest + 1,
                created: chrono::Utc::now().to_rfc3339(),
                weights: weights.clone(),
                ..body.clone()
            };

            if let Some(unchanged) = unchanged(&folder, &body, newest.as_ref())? {
                // At a quota, a missing object was not written again.
                if self.lacks(&folder, body.objects()).await? {
                    publication.check(&unchanged.manifest)?;
                }
                return Ok(unchanged);
            }
            if let Some(policy) = policy {
                let newest = newest.as_ref().map(|newest| newest.revision);
                self.check_policy(Kind::Adapter, name, newest, policy)
                    .await?;
            }

            let manifest = revision_path(&folder, body.revision).to_string();
            if self
                .write_manifest(
                    &publication,
                    &folder,
                    body.revision,
                    manifest::encode(&manifest, &body)?,
                )
                .await?
            {
                // From now on the manifest protects its object from garbage collection. An object
                // collected before is written again.
                if self.lacks(&folder, body.objects()).await? {
                    self.write_object(&publication, &folder, "weights", "safetensors", content)
                        .await?;
                }
                return Ok(Published {
                    revision: body.revision,
                    is_new: true,
                    manifest,
                });
            }
        }

        Err(Error::Contended {
            name: name.to_owned(),
        })
    }

    /// Loads an adapter, in the given revision or else the current one, and checks that its golden
    /// inputs still give their stored outputs.
    ///
    /// # Errors
    /// [`Error::Unknown`] or [`Error::UnknownRevision`] if the adapter or revision does not exist,
    /// [`Error::Damaged`] if a file is truncated or altered or the golden outputs are not
    /// reproduced, [`Error::Schema`] if a newer program wrote it, [`Error::Absent`] or
    /// [`Error::Io`] if a file is missing or cannot be read.
    pub async fn load_adapter(
        &self,
        name: &str,
        revision: Option<u64>,
    ) -> Result<StoredAdapter, Error> {
        let (folder, revision) = self.resolve(Kind::Adapter, name, revision).await?;
        let body = self.adapter_body(&folder, revision).await?;
        let (file, bytes) = self.read_object(&folder, &body.weights).await?;

        let manifest = self.shown(&revision_path(&folder, revision));
        assembled(body, &manifest, &file, &bytes)
    }

    /// Publishes the manifest and weights files of another store's revision as a new revision of
    /// `name`. Both are checked like on loading.
    ///
    /// # Errors
    /// [`Error::Damaged`] if the manifest or the weights are truncated, altered or do not belong
    /// together, [`Error::Exists`] or [`Error::Unknown`] if the adapter does not satisfy `policy`,
    /// otherwise as [`Store::publish_adapter`].
    pub async fn upload_adapter_files(
        &self,
        name: &str,
        manifest: &[u8],
        weights: Vec<u8>,
        policy: UploadPolicy,
    ) -> Result<Published, Error> {
        if !is_plain_name(name) {
            return Err(Error::Name {
                what: "an adapter",
                name: name.to_owned(),
            });
        }

        check_adapter_files(manifest, &weights)?;
        let body = manifest::decode(UPLOADED_MANIFEST, manifest)?;
        self.publish_body(name, body, weights, Some(policy)).await
    }

    /// Checks the condition of an upload, without writing. Whether the content is the same is not
    /// checked: an adapter that exists can only be replaced.
    ///
    /// # Errors
    /// As [`Store::upload_adapter_files`].
    pub async fn check_adapter_upload(
        &self,
        name: &str,
        policy: UploadPolicy,
    ) -> Result<(), Error> {
        let folder = folder_of(Kind::Adapter, name);
        let newest = self.revisions(&folder).await?.present.last().copied();
        self.check_policy(Kind::Adapter, name, newest, policy).await
    }

    /// The manifest and weights files of an adapter, for publishing in another store.
    ///
    /// # Errors
    /// As [`Store::load_adapter`].
    pub async fn adapter_files(
        &self,
        name: &str,
        revision: Option<u64>,
    ) -> Result<(Vec<u8>, Vec<u8>), Error> {
        let (folder, revision) = self.resolve(Kind::Adapter, name, revision).await?;
        let manifest = self.read(&revision_path(&folder, revision)).await?;
        let body = self.adapter_body(&folder, revision).await?;
        let (_, weights) = self.read_object(&folder, &body.weights).await?;

        Ok((manifest, weights))
    }

    /// The room that an adapter belongs to: its newest revision is fitted to the room, and its name
    /// is `ROOM.NAME`. `None` if it belongs to no room, or is not in the store.
    ///
    /// # Errors
    /// [`Error::Damaged`] if its newest manifest is truncated or altered, [`Error::Schema`] if a
    /// newer program wrote it, [`Error::Io`] if the store cannot be read.
    pub async fn owner_of(&self, adapter: &str) -> Result<Option<String>, Error> {
        let newest = self.newest_adapter(adapter).await?;
        Ok(newest.and_then(|body| body.owner().map(str::to_owned)))
    }

    /// The manifest of an adapter's highest revision, also if that was removed. Removing a revision
    /// keeps its manifest until the garbage is collected.
    pub(super) async fn last_adapter(&self, name: &str) -> Result<Option<AdapterBody>, Error> {
        let folder = folder_of(Kind::Adapter, name);
        let numbers = self.revisions(&folder).await?;
        if !numbers.present.is_empty() {
            return self.newest_adapter(name).await;
        }

        let gone = folder.join("revisions").join(gone_name(numbers.highest));
        match self.read(&gone).await {
            Ok(bytes) => Ok(Some(manifest::decode(&self.shown(&gone), &bytes)?)),
            Err(Error::Absent { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The manifest of an adapter's newest revision, if there is one.
    pub(super) async fn newest_adapter(&self, name: &str) -> Result<Option<AdapterBody>, Error> {
        let folder = folder_of(Kind::Adapter, name);
        let Some(&newest) = self.revisions(&folder).await?.present.last() else {
            return Ok(None);
        };
        match self.adapter_body(&folder, newest).await {
            Ok(body) => Ok(Some(body)),
            // It was removed meanwhile.
            Err(Error::Absent { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The names of all adapters, sorted.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn adapter_names(&self) -> Result<Vec<String>, Error> {
        self.names(Kind::Adapter).await
    }

    /// The names of all adapters, sorted, each with its current revision under `defaults`. Reads no
    /// manifest.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn current_adapters(&self, defaults: &Defaults) -> Result<Vec<(String, u64)>, Error> {
        self.current(Kind::Adapter, defaults).await
    }

    pub(super) async fn adapter_body(
        &self,
        folder: &Path,
        revision: u64,
    ) -> Result<AdapterBody, Error> {
        let path = revision_path(folder, revision);
        let file = self.shown(&path);
        let body: AdapterBody = manifest::decode(&file, &self.read(&path).await?)?;
        manifest::check_place(&file, folder, (&body.adapter, body.revision), revision)?;

        Ok(body)
    }
}

/// The newest revision, if it equals `body` except for the revision number and the date.
fn unchanged(
    folder: &Path,
    body: &AdapterBody,
    newest: Option<&AdapterBody>,
) -> Result<Option<Published>, Error> {
    let Some(newest) = newest else {
        return Ok(None);
    };
    let same = AdapterBody {
        revision: newest.revision,
        created: newest.created.clone(),
        ..body.clone()
    };

    let is_same = as_json(&same)? == as_json(newest)?;
    Ok(is_same.then(|| Published {
        revision: newest.revision,
        is_new: false,
        manifest: revision_path(folder, newest.revision).to_string(),
    }))
}

/// A body as it is stored. Undefined scores are NaN in memory and null here, where they are equal.
fn as_json(body: &AdapterBody) -> Result<serde_json::Value, Error> {
    serde_json::to_value(body).map_err(|error| Error::Damaged {
        file: body.adapter.clone(),
        problem: error.into(),
    })
}
