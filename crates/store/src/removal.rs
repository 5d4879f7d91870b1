//! Removing revisions.
//!
//! A removed revision is out of sight at once: its manifest `000003.json` becomes `000003.gone`. The
//! number is never given again, since servers and records tell revisions apart by it. The objects
//! stay until [`Store::collect_garbage`] finds that nothing needs them.

use object_store::ObjectStoreExt;

use super::defaults::{Choice, Defaults};
use super::{Error, Kind, ResourceName, Store, folder_of, gone_name, revision_path};

/// What a removal took out of sight.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Removed {
    /// The revisions, in ascending order.
    pub revisions: Vec<u64>,
}

impl Store {
    /// What [`Store::remove`] would do.
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
                    "{fitted} was fitted from it and reads motions with it; remove that first"
                )));
            }
        }

        Ok(Removed { revisions })
    }

    /// Removes a revision, or a whole room or adapter with all its revisions and what was chosen for
    /// it. If the program stops in between, the newest revisions are still there.
    ///
    /// # Errors
    /// [`Error::Unknown`] or [`Error::UnknownRevision`] if it is not in the store, [`Error::InUse`]
    /// if a default names it or a fitted adapter needs it, otherwise as [`Store::load_adapter`] if a
    /// manifest cannot be read, or [`Error::Io`] if the store cannot be written.
    pub async fn remove(&self, resource: &ResourceName) -> Result<Removed, Error> {
        let removed = self.check_removable(resource).await?;
        let folder = folder_of(resource.kind, &resource.name);

        // A default that named what is gone would hide what is still there.
        if resource.revision.is_none() {
            self.choose(&Choice::Nothing(resource.clone())).await?;
        }

        // The oldest first, so that no older revision is ever taken for the newest.
        for &revision in &removed.revisions {
            let manifest = revision_path(&folder, revision);
            let gone = folder.clone().join("revisions").join(gone_name(revision));
            let bytes = self.read(&manifest).await?;
            if let Err(error) = self.write_new(&gone, bytes).await {
                // A full disk still takes a second name of the same file, and whoever removes wants
                // to have room again.
                match self.objects.copy_if_not_exists(&manifest, &gone).await {
                    Ok(()) | Err(object_store::Error::AlreadyExists { .. }) => {}
                    Err(_) => return Err(error),
                }
            }

            let deleted = self.objects.delete(&manifest).await;
            deleted.map_err(|error| self.io(&manifest, error))?;
        }

        Ok(removed)
    }

    /// The fitted adapters that read motions with one of these revisions of an adapter.
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

/// Why a default keeps this from being removed, if one does.
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
