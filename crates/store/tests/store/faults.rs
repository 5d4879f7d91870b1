//! An object store in memory that fails at random, in simulated time.
//!
//! An operation may take long, fail before it has an effect, fail after it (a lost
//! acknowledgement), or leave half of a new file. Modification times are simulated: they have
//! nothing to do with this machine's clock.

use std::collections::HashMap;
use std::fmt;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use chrono::{DateTime, TimeDelta, Utc};
use futures_util::StreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, ObjectStoreExt, PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult,
    Result,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::time::Instant;

type BoxStream<'a, T> = Pin<Box<dyn futures_util::Stream<Item = T> + Send + 'a>>;

/// Probability that an operation fails.
const FAILURE: f64 = 0.1;
/// Probability that an operation takes minutes.
const STALL: f64 = 0.02;

/// A store that fails at random. Clones share the files.
#[derive(Debug, Clone)]
pub struct Faulty(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    files: InMemory,
    times: Mutex<HashMap<Path, DateTime<Utc>>>,
    random: Mutex<ChaCha8Rng>,
    start: Instant,
    faults: Mutex<Faults>,
}

#[derive(Debug, Default)]
struct Faults {
    is_repaired: bool,
    count: usize,
}

/// What goes wrong in an operation.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// Nothing is done.
    Before,
    /// Everything is done, but the caller gets an error.
    LostAcknowledgement,
    /// Half of a new file is written.
    Half,
}

impl Faulty {
    pub fn new(seed: u64) -> Self {
        Self(Arc::new(Shared {
            files: InMemory::new(),
            times: Mutex::default(),
            random: Mutex::new(ChaCha8Rng::seed_from_u64(seed)),
            start: Instant::now(),
            faults: Mutex::default(),
        }))
    }

    /// Number of faults so far.
    pub fn count(&self) -> usize {
        self.0.faults.lock().unwrap().count
    }

    /// Ends all faults.
    pub fn repair(&self) {
        self.0.faults.lock().unwrap().is_repaired = true;
    }

    /// The store's clock: it began in the year 2001.
    fn now(&self) -> DateTime<Utc> {
        let start = DateTime::from_timestamp(1_000_000_000, 0).unwrap();
        start + TimeDelta::from_std(self.0.start.elapsed()).unwrap()
    }

    /// Takes the time of an operation, and decides what goes wrong.
    async fn begin(&self) -> Option<Fault> {
        let (pause, fault) = {
            let mut faults = self.0.faults.lock().unwrap();
            if faults.is_repaired {
                return None;
            }

            let mut random = self.0.random.lock().unwrap();
            let pause = if random.random_bool(STALL) {
                Duration::from_secs(random.random_range(60..2_400))
            } else {
                Duration::from_millis(random.random_range(1..80))
            };
            let fault = random
                .random_bool(FAILURE)
                .then(|| match random.random_range(0..4) {
                    0 | 1 => Fault::LostAcknowledgement,
                    2 => Fault::Before,
                    _ => Fault::Half,
                });
            faults.count += usize::from(fault.is_some());
            (pause, fault)
        };

        tokio::time::sleep(pause).await;
        fault
    }

    fn touch(&self, path: &Path) {
        let now = self.now();
        self.0.times.lock().unwrap().insert(path.clone(), now);
    }

    fn timed(&self, meta: ObjectMeta) -> ObjectMeta {
        let times = self.0.times.lock().unwrap();
        let time = times.get(&meta.location).copied();
        ObjectMeta {
            last_modified: time.unwrap_or(meta.last_modified),
            ..meta
        }
    }

    /// All files, as they are.
    pub async fn paths(&self) -> Vec<String> {
        let listed: Vec<_> = self.0.files.list(None).collect().await;
        let mut paths: Vec<String> = listed
            .into_iter()
            .map(|entry| entry.unwrap().location.to_string())
            .collect();
        paths.sort();
        paths
    }

    async fn removed(&self, path: Path) -> Result<Path> {
        let fault = self.begin().await;
        if matches!(fault, Some(Fault::Before | Fault::Half)) {
            return Err(failed());
        }
        self.0.files.delete(&path).await?;
        match fault {
            None => Ok(path),
            Some(_) => Err(failed()),
        }
    }
}

fn failed() -> Error {
    Error::Generic {
        store: "faulty",
        source: "a simulated fault".into(),
    }
}

impl fmt::Display for Faulty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("faulty")
    }
}

#[async_trait::async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        opts: PutOptions,
    ) -> Result<PutResult> {
        let fault = self.begin().await;
        if fault == Some(Fault::Before) {
            return Err(failed());
        }

        // A store never replaces a whole file by half of one, or creates half of one that must be
        // new: that is the contract of a put.
        if fault == Some(Fault::Half) {
            let is_there = self.0.files.head(location).await.is_ok();
            if !is_there && opts.mode == PutMode::Overwrite {
                let bytes: Vec<u8> = payload.iter().flatten().copied().collect();
                let half = bytes[..bytes.len() / 2].to_vec();
                self.0.files.put(location, half.into()).await?;
                self.touch(location);
            }
            return Err(failed());
        }

        let put = self.0.files.put_opts(location, payload, opts).await?;
        self.touch(location);
        match fault {
            None => Ok(put),
            Some(_) => Err(failed()),
        }
    }

    async fn put_multipart_opts(
        &self,
        _: &Path,
        _: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        Err(failed())
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        if self.begin().await.is_some() {
            return Err(failed());
        }
        let found = self.0.files.get_opts(location, options).await?;
        Ok(GetResult {
            meta: self.timed(found.meta.clone()),
            ..found
        })
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let store = self.clone();
        let removed = locations.then(move |location| {
            let store = store.clone();
            async move { store.removed(location?).await }
        });
        Box::pin(removed)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let store = self.clone();
        let prefix = prefix.cloned();
        let listed = async move {
            if store.begin().await.is_some() {
                return vec![Err(failed())];
            }
            let listed = store.0.files.list(prefix.as_ref());
            let timed = listed.map(|entry| Ok(store.timed(entry?)));
            timed.collect().await
        };
        let entries = futures_util::stream::once(listed).flat_map(futures_util::stream::iter);
        Box::pin(entries)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        if self.begin().await.is_some() {
            return Err(failed());
        }
        self.0.files.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        let fault = self.begin().await;
        if matches!(fault, Some(Fault::Before | Fault::Half)) {
            return Err(failed());
        }
        self.0.files.copy_opts(from, to, options).await?;
        self.touch(to);
        match fault {
            None => Ok(()),
            Some(_) => Err(failed()),
        }
    }
}
