//! Removing revisions.
//!
//! A removed revision disappears immediately: its manifest `000003.json` is renamed to
//! `000003.gone`. The number is never reused, because servers and records identify revisions by it.
//! The objects remain until [`Store::collect_garbage`] finds them unreferenced.

use object_store::ObjectStoreExt;
use object_store::path::Path;

use super::defaults::{Choice, Defaults};
use super::{Error, Kind, ResourceName, Store, folder_of, gone_name, revision_path};

/// The result of a removal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Removed {
    /// The removed revisions, in ascending order.
    pub revisions: Vec<u64>,
}

impl Store {
    /// Checks whether [`Store::remove`] would succeed, and returns what it would remove.
    ///
    /// # Errors
    /// As [`Store::remove`].
    pub async fn check_removable(&self, resource: &ResourceName) -> Result<Removed, Error> {
        self.check_exists(resource).await?;
        let in_use = |reason: String| Error::InUse {
            resource: resource.to_string(),
            reason,
        };

        let defaults = self.defaults().await?;
        if let Some(reason) = chosen(&defaults, resource) {
            return Err(in_use(reason));
        }

        let folder = folder_of(resource.kind, &resource.name);
        let revisions = match resource.revision {
            Some(revision) => vec![revision],
            None => self.revisions(&folder).await?.present,
        };

        if resource.kind == Kind::Adapter {
            let fitted = self.fitted_from(&resource.name, &revisions).await?;
            if let Some(fitted) = fitted.first() {
                return Err(in_use(format!(
                    "{fitted} was fitted from it and still uses it; remove that first"
                )));
            }
        }

        Ok(Removed { revisions })
    }

    /// Removes one revision, or a whole room or adapter with all its revisions and defaults. After
    /// an interruption, the newest revisions still exist.
    ///
    /// # Errors
    /// [`Error::Unknown`] or [`Error::UnknownRevision`] if it is not in the store; [`Error::InUse`]
    /// if a default refers to it or a fitted adapter needs it; [`Error::Io`] if the store cannot be
    /// written; as [`Store::load_adapter`] if a manifest cannot be read.
    pub async fn remove(&self, resource: &ResourceName) -> Result<Removed, Error> {
        let removed = self.check_removable(resource).await?;
        let folder = folder_of(resource.kind, &resource.name);

        // A default that refers to a removed revision would hide the remaining ones, so clear it
        // first.
        if resource.revision.is_none() {
            self.choose(&Choice::Nothing(resource.clone())).await?;
        }

        // Oldest first, so that an older revision never becomes the newest.
        for &revision in &removed.revisions {
            self.retire(&folder, revision).await?;
        }

        Ok(removed)
    }

    /// Removes a revision. Its number is not used again.
    pub(super) async fn retire(&self, folder: &Path, revision: u64) -> Result<(), Error> {
        let manifest = revision_path(folder, revision);
        let gone = folder.clone().join("revisions").join(gone_name(revision));
        let bytes = self.read(&manifest).await?;
        if let Err(error) = self.write_new(&gone, bytes).await {
            // On a full disk, hard-linking the manifest still works, and removal must work there to
            // free space.
            match self.objects.copy_if_not_exists(&manifest, &gone).await {
                Ok(()) | Err(object_store::Error::AlreadyExists { .. }) => {}
                Err(_) => return Err(error),
            }
        }

        let deleted = self.objects.delete(&manifest).await;
        deleted.map_err(|error| self.io(&manifest, error))
    }

    /// The fitted adapters whose base is one of these revisions of an adapter.
    async fn fitted_from(&self, base: &str, revisions: &[u64]) -> Result<Vec<ResourceName>, Error> {
        let mut fitted = Vec::new();
        for (name, numbers) in self.numbered(Kind::Adapter).await? {
            if name == base {
                continue;
            }

            let folder = folder_of(Kind::Adapter, &name);
            for revision in numbers.present {
                let body = self.adapter_body(&folder, revision).await?;
                let from = body.fitted_to.and_then(|fit| fit.base);
                if from.is_some_and(|(from, number)| from == base && revisions.contains(&number)) {
                    fitted.push(ResourceName::adapter(name.clone()).at(revision));
                }
            }
        }

        Ok(fitted)
    }
}

/// The reason why a default prevents the removal, if one does.
fn chosen(defaults: &Defaults, resource: &ResourceName) -> Option<String> {
    if let Some(revision) = resource.revision
        && defaults.revision(resource.kind, &resource.name) == Some(revision)
    {
        return Some("it is the default revision; choose another first".to_owned());
    }

    if resource.kind == Kind::Adapter && resource.revision.is_none() {
        let room = defaults.rooms_of(&resource.name).next()?;
        return Some(format!(
            "it is the default adapter of rooms/{room}; choose another first"
        ));
    }

    None
}
