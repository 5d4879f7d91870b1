//! Verification of a store: every file is readable and intact, and references are valid.

use std::collections::BTreeSet;

use strum::VariantArray;

use super::manifest::ObjectRef;
use super::{Error, Kind, ResourceName, Store, folder_of};

/// A problem found in a store.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// The affected resource: a revision, or `defaults`.
    #[serde(rename = "name")]
    pub resource: String,
    /// Description of the problem, with the file if there is one.
    pub problem: String,
}

impl Store {
    /// Verifies every revision of every room and adapter: checksums of manifests and objects,
    /// golden vectors of adapters, and references to other resources. `seen` is called with each
    /// revision before it is read.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be listed. Every other problem is returned as a finding.
    pub async fn verify(
        &self,
        seen: &(dyn Fn(&ResourceName) + Sync),
    ) -> Result<Vec<Finding>, Error> {
        let mut findings = Vec::new();

        for &kind in Kind::VARIANTS {
            for (name, numbers) in self.numbered(kind).await? {
                // Revisions share objects. A revision without new objects needs only its manifest
                // checked.
                let mut intact = BTreeSet::new();

                for revision in numbers.present {
                    let resource = ResourceName {
                        kind,
                        name: name.clone(),
                        revision: Some(revision),
                    };
                    seen(&resource);
                    let checked = self.verify_revision(&resource, revision, &mut intact).await;
                    if let Err(error) = checked {
                        findings.push(Finding {
                            resource: resource.to_string(),
                            problem: error.to_string(),
                        });
                    }
                }
            }
        }

        if let Err(error) = self.verify_defaults().await {
            findings.push(Finding {
                resource: "defaults".to_owned(),
                problem: error.to_string(),
            });
        }

        Ok(findings)
    }

    async fn verify_revision(
        &self,
        resource: &ResourceName,
        revision: u64,
        intact: &mut BTreeSet<String>,
    ) -> Result<(), Error> {
        let folder = folder_of(resource.kind, &resource.name);

        match resource.kind {
            Kind::Adapter => {
                let stored = self.load_adapter(&resource.name, Some(revision)).await?;
                let base = stored.room_fit.and_then(|fit| fit.base);
                if let Some(base) = base {
                    let base = ResourceName::adapter(base.name).at(base.revision);
                    self.check_exists(&base).await?;
                }
            }
            Kind::Room => {
                let body = self.room_body(&folder, revision).await?;
                let objects: Vec<ObjectRef> = body
                    .objects()
                    .filter(|object| !intact.contains(&object.file))
                    .cloned()
                    .collect();

                // Load the room only if it has objects that were not verified yet.
                if !objects.is_empty() {
                    self.load_room(&resource.name, Some(revision)).await?;
                }
                intact.extend(objects.into_iter().map(|object| object.file));
            }
        }

        Ok(())
    }

    async fn verify_defaults(&self) -> Result<(), Error> {
        for resource in self.defaults().await?.named() {
            self.check_exists(&resource).await?;
        }
        Ok(())
    }
}
