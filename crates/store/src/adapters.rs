//! Publishing and loading adapters.

use ndarray::ArrayView2;
use object_store::path::Path;

use super::adapter_files::{
    TWIST_FRAME, UPLOADED_MANIFEST, adapter_file, assembled, check_adapter_files,
};
use super::format::{AdapterBody, FittedEntry, TrainingEntry};
use super::manifest::{self, ObjectRef, SCHEMA};
use super::stored_adapter::{RoomFit, StoredAdapter};
use super::{ATTEMPTS, Defaults, Error, Kind, Published, Store, folder_of, revision_path};
use seese3_core::adapter::{Adapter, TrainingRecord};
use seese3_core::room::is_plain_name;
use seese3_robot::fitting::Fitted;

/// What an adapter is published for.
enum Purpose<'a> {
    AnyRoom,
    OneRoom(&'a RoomFit),
    Experiment,
}

impl Store {
    /// Publishes an adapter as a new revision. Some rows of `features` (n, d), the features that it
    /// was trained on, are stored as golden inputs, together with the outputs that it gives for
    /// them. Publishing the same content again creates no revision.
    ///
    /// # Errors
    /// [`Error::Name`] if the name cannot be a folder, [`Error::Damaged`] if the features do not
    /// fit the adapter, [`Error::Contended`] if other publishers took every revision number that
    /// was tried, otherwise as [`Store::load_adapter`] if the newest revision cannot be read, or
    /// [`Error::Io`] if the store cannot be written.
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

    /// Publishes an adapter of an experiment, as [`Store::publish_adapter`] does. It answers where it is
    /// named; by default only where no other adapter fits.
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

    /// Publishes an adapter that was fitted to a room, as [`Store::publish_adapter`] does.
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
            source: adapter.source().into(),
            twist_frame: TWIST_FRAME.to_owned(),
            // σ of the targets is divided by n, not by n − 1.
            deviation_ddof: 0,
            training: TrainingEntry::new(record, adapter),
            fitted_to: room_fit.map(FittedEntry::from),
            experiment: matches!(purpose, Purpose::Experiment),
            // What follows is set when it is published.
            adapter: String::new(),
            revision: 0,
            created: String::new(),
            weights: ObjectRef::default(),
        };
        self.publish_body(name, body, bytes).await
    }

    /// Publishes a manifest with its weights under a name. Name, revision, date and the reference to
    /// the weights are set here.
    async fn publish_body(
        &self,
        name: &str,
        body: AdapterBody,
        weights: Vec<u8>,
    ) -> Result<Published, Error> {
        let folder = folder_of(Kind::Adapter, name);

        // The weights are written before the manifest that makes them visible.
        let content = weights;
        let weights = self
            .write_object(&folder, "weights", "safetensors", content.clone())
            .await?;

        // As for rooms: try to create the next revision, and start again if another publisher was
        // faster.
        for _ in 0..ATTEMPTS {
            let numbers = self.revisions(&folder).await?;
            let newest = match numbers.present.last() {
                Some(&revision) => Some(self.adapter_body(&folder, revision).await?),
                None => None,
            };

            let body = AdapterBody {
                adapter: name.to_owned(),
                revision: numbers.highest + 1,
                created: chrono::Utc::now().to_rfc3339(),
                weights: weights.clone(),
                ..body.clone()
            };

            // Content that differs only in the revision number and the date is not published again.
            if let Some(newest) = newest {
                let same = AdapterBody {
                    revision: newest.revision,
                    created: newest.created.clone(),
                    ..body.clone()
                };

                if same == newest {
                    let manifest = revision_path(&folder, newest.revision).to_string();
                    return Ok(Published {
                        revision: newest.revision,
                        is_new: false,
                        manifest,
                    });
                }
            }

            let manifest = revision_path(&folder, body.revision).to_string();
            if self
                .write_manifest(&folder, body.revision, manifest::encode(&manifest, &body)?)
                .await?
            {
                // The manifest keeps its object from now on. What was collected before is written
                // again.
                if self.lacks(&folder, body.objects()).await? {
                    self.write_object(&folder, "weights", "safetensors", content)
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

    /// Loads an adapter, the given revision or else the one that its name alone means, and checks that its golden inputs
    /// still give their stored outputs.
    ///
    /// # Errors
    /// [`Error::Unknown`] if there is no such adapter, [`Error::UnknownRevision`] if it has no such
    /// revision, [`Error::Damaged`] if a file is truncated or altered or the golden outputs are not
    /// reproduced, [`Error::Schema`] if a newer program wrote it, [`Error::Io`] if a file cannot be
    /// read.
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

    /// Publishes a revision that was taken from another store as a new revision of `name`: its
    /// manifest and its weights, as they stand in the files there. Both are checked as if they were
    /// loaded.
    ///
    /// # Errors
    /// [`Error::Damaged`] if the manifest or the weights are truncated, altered or do not belong
    /// together, otherwise as [`Store::publish_adapter`].
    pub async fn publish_adapter_files(
        &self,
        name: &str,
        manifest: &[u8],
        weights: Vec<u8>,
    ) -> Result<Published, Error> {
        if !is_plain_name(name) {
            return Err(Error::Name {
                what: "an adapter",
                name: name.to_owned(),
            });
        }

        check_adapter_files(manifest, &weights)?;
        let body = manifest::decode(UPLOADED_MANIFEST, manifest)?;
        self.publish_body(name, body, weights).await
    }

    /// The files of an adapter, to be published in another store: its manifest and its weights.
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

    /// The names of all adapters, sorted.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed.
    pub async fn adapter_names(&self) -> Result<Vec<String>, Error> {
        self.names(Kind::Adapter).await
    }

    /// The names of all adapters, sorted, each with the revision that its name alone means by these
    /// choices. No manifest is read.
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
