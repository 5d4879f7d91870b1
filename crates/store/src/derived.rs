//! What servers derive from the frames of a room and an adapter, kept in the folder `derived`.
//!
//! A file is named by the hash of the content that it was derived from: frames, features, weights, and
//! the version of the computation. It holds the SHA-256 of its tensors, and the tensors. A missing or
//! damaged file costs time only; garbage collection removes the files of revisions that are gone.

use std::collections::BTreeSet;

use ndarray::{Array1, Array2};
use object_store::path::Path;
use object_store::{ObjectStoreExt, PutPayload};
use sha2::{Digest, Sha256};

use super::format::{AdapterBody, RoomBody};
use super::tensors::{TensorReader, TensorWriter};
use super::{Error, Kind, Store, StoredAdapter, folder_of, sha256};
use seese3_robot::tracking::{FeatureTables, MapTables};

/// The folder of the files.
pub(super) const FOLDER: &str = "derived";
const CHECKSUM_BYTES: usize = 32;

const LATENTS: &str = "latents";
const TYPICAL_DISTANCE: &str = "map.typical_distance";
const ERRORS: &str = "map.errors";
const MEAN: &str = "map.feature.mean";
const COMPONENTS: &str = "map.feature.components";
const COORDINATES: &str = "map.feature.coordinates";
const FEATURE_ERRORS: &str = "map.feature.errors";

/// What is derived from the frames of a room and an adapter.
#[derive(Debug, Clone, PartialEq)]
pub struct Derived {
    /// Latents of all frames, shape (n, k).
    pub latents: Array2<f64>,
    /// Tables of the map of all frames; `None` if the adapter cannot track in the room.
    pub map: Option<MapTables>,
}

/// The content that something is derived from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DerivedKey(String);

impl DerivedKey {
    /// The key of a room and an adapter; `None` if the room lacks the adapter's features.
    fn of(room: &RoomBody, adapter: &AdapterBody) -> Option<Self> {
        // The same choice as in `Features::of_source`.
        let features = adapter.source.parts().iter().map(|part| {
            let mut entries = room.features.iter();
            let entry = entries.find(|entry| entry.source.is_like(part))?;
            Some(entry.object.sha256.as_str())
        });
        let features: Option<Vec<&str>> = features.collect();

        let text = format!(
            "{} {}\n{}\n{}\n{}",
            env!("CARGO_PKG_VERSION"),
            MapTables::VERSION,
            room.frames.sha256,
            features?.join(" "),
            adapter.weights.sha256,
        );
        Some(Self(sha256(text.as_bytes())))
    }

    fn path(&self) -> Path {
        Path::from(FOLDER).join(format!("{}.tensors", self.0))
    }
}

impl Store {
    /// The key of what is derived from a revision of a room and an adapter; `None` if the room lacks the
    /// adapter's features.
    ///
    /// # Errors
    /// As [`Store::load_room`], of the manifests alone.
    pub async fn derived_key(
        &self,
        room: &str,
        revision: u64,
        adapter: &StoredAdapter,
    ) -> Result<Option<DerivedKey>, Error> {
        let room = self
            .room_body(&folder_of(Kind::Room, room), revision)
            .await?;
        let folder = folder_of(Kind::Adapter, &adapter.name);
        let adapter = self.adapter_body(&folder, adapter.revision).await?;
        Ok(DerivedKey::of(&room, &adapter))
    }

    /// What was derived before; `None` if nothing was kept, or the file is damaged.
    pub async fn load_derived(&self, key: &DerivedKey) -> Option<Derived> {
        let path = key.path();
        let bytes = self.read(&path).await.ok()?;
        let (checksum, tensors) = bytes.split_first_chunk::<CHECKSUM_BYTES>()?;
        let is_whole = *checksum == <[u8; CHECKSUM_BYTES]>::from(Sha256::digest(tensors));
        let derived = is_whole.then(|| read(&self.shown(&path), tensors).ok());
        derived.flatten()
    }

    /// Keeps what was derived. The file is replaced as a whole.
    ///
    /// # Errors
    /// [`Error::Io`] if the store cannot be written.
    pub async fn keep_derived(&self, key: &DerivedKey, derived: &Derived) -> Result<(), Error> {
        let path = key.path();
        let tensors = write(derived, &self.shown(&path))?;
        let bytes = [Sha256::digest(&tensors).as_slice(), &tensors].concat();
        let written = self.objects.put(&path, PutPayload::from(bytes)).await;
        written.map(|_| ()).map_err(|error| self.io(&path, error))
    }

    /// The paths of the files that may be derived from the present revisions.
    pub(super) async fn derived_paths(&self) -> Result<BTreeSet<String>, Error> {
        let mut rooms = Vec::new();
        for (folder, revision) in self.present(Kind::Room).await? {
            rooms.extend(unless_removed(self.room_body(&folder, revision).await)?);
        }

        let mut paths = BTreeSet::new();
        for (folder, revision) in self.present(Kind::Adapter).await? {
            let adapter = unless_removed(self.adapter_body(&folder, revision).await)?;
            let Some(adapter) = adapter else {
                continue;
            };
            let keys = rooms
                .iter()
                .filter_map(|room| DerivedKey::of(room, &adapter));
            paths.extend(keys.map(|key| key.path().to_string()));
        }
        Ok(paths)
    }

    /// All revisions of this kind, each with the folder of its room or adapter.
    async fn present(&self, kind: Kind) -> Result<Vec<(Path, u64)>, Error> {
        let numbered = self.numbered(kind).await?;
        let revisions = numbered.into_iter().flat_map(|(name, numbers)| {
            let folder = folder_of(kind, &name);
            let present = numbers.present.into_iter();
            present.map(move |revision| (folder.clone(), revision))
        });
        Ok(revisions.collect())
    }
}

/// A manifest, or `None` if it was removed after it was listed.
fn unless_removed<T>(body: Result<T, Error>) -> Result<Option<T>, Error> {
    match body {
        Ok(body) => Ok(Some(body)),
        Err(Error::Absent { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

fn write(derived: &Derived, file: &str) -> Result<Vec<u8>, Error> {
    let mut tensors = TensorWriter::default();
    let mut matrix = |name: &str, rows: &Array2<f64>| {
        let shape = [rows.nrows(), rows.ncols()];
        tensors.f64(name, &shape, rows.iter().copied());
    };
    matrix(LATENTS, &derived.latents);

    if let Some(map) = &derived.map {
        if let Some(FeatureTables {
            mean,
            components,
            coordinates,
            errors,
        }) = &map.by_feature
        {
            matrix(COMPONENTS, components);
            matrix(COORDINATES, coordinates);
            tensors.f64(MEAN, &[mean.len()], mean.iter().copied());
            let shape = [errors.len(), MapTables::ERRORS];
            tensors.f64(FEATURE_ERRORS, &shape, errors.iter().flatten().copied());
        }
        tensors.f64(TYPICAL_DISTANCE, &[1], [map.typical_distance].into_iter());
        if let Some(errors) = &map.errors {
            tensors.f64(ERRORS, &[errors.len()], errors.iter().copied());
        }
    }

    tensors.finish(file)
}

fn read(file: &str, bytes: &[u8]) -> Result<Derived, Error> {
    let tensors = TensorReader::new(file, bytes)?;
    let row = |name: &str| Ok::<_, Error>(tensors.f64(name)?.into_iter().collect::<Vec<f64>>());

    // A map that lacks numbers is not made of these tables.
    let by_feature = || {
        let errors = row(FEATURE_ERRORS)?;
        let (first, second) = errors.split_at(errors.len().min(MapTables::ERRORS));
        let errors = [first.to_vec(), second.to_vec()];

        Ok::<_, Error>(FeatureTables {
            mean: Array1::from(row(MEAN)?),
            components: tensors.f64(COMPONENTS)?,
            coordinates: tensors.f64(COORDINATES)?,
            errors,
        })
    };

    let map = || {
        Ok::<_, Error>(MapTables {
            typical_distance: row(TYPICAL_DISTANCE)?.first().copied().unwrap_or(f64::NAN),
            errors: tensors.has(ERRORS).then(|| row(ERRORS)).transpose()?,
            by_feature: tensors.has(MEAN).then(by_feature).transpose()?,
        })
    };

    Ok(Derived {
        latents: tensors.f64(LATENTS)?,
        map: tensors.has(TYPICAL_DISTANCE).then(map).transpose()?,
    })
}
