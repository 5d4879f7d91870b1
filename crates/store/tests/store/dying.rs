//! An object store whose writes fail after so many: a publisher that is killed, seen from the disk.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use std::pin::Pin;

use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};
use tokio_stream::Stream;

type BoxStream<'a, T> = Pin<Box<dyn Stream<Item = T> + Send + 'a>>;

/// Lets `survives` writes and removals through and refuses all others.
#[derive(Debug)]
pub struct Dying<S> {
    inner: S,
    survives: usize,
    writes: Arc<AtomicUsize>,
    /// Files can still be removed and get other names.
    only_full: bool,
    /// Conditions of writes are ignored.
    ignores_conditions: bool,
}

impl<S> Dying<S> {
    pub fn new(inner: S, survives: usize) -> Self {
        Self {
            inner,
            survives,
            writes: Arc::default(),
            only_full: false,
            ignores_conditions: false,
        }
    }

    /// A server that replaces objects even on the condition that there is none.
    pub fn unconditional(inner: S) -> Self {
        Self {
            ignores_conditions: true,
            ..Self::new(inner, usize::MAX)
        }
    }

    /// A full disk: nothing can be written, but files can be removed and get second names.
    pub fn full(inner: S) -> Self {
        Self {
            only_full: true,
            ..Self::new(inner, 0)
        }
    }
}

impl<S> fmt::Display for Dying<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("dying")
    }
}

fn killed() -> Error {
    Error::Generic {
        store: "dying",
        source: "killed".into(),
    }
}

#[async_trait::async_trait]
impl<S: ObjectStore> ObjectStore for Dying<S> {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        opts: PutOptions,
    ) -> Result<PutResult> {
        if self.writes.fetch_add(1, Ordering::Relaxed) >= self.survives {
            return Err(killed());
        }
        let opts = match self.ignores_conditions {
            true => PutOptions::default(),
            false => opts,
        };
        self.inner.put_opts(location, payload, opts).await
    }

    async fn put_multipart_opts(
        &self,
        _: &Path,
        _: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        Err(killed())
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.inner.get_opts(location, options).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        use tokio_stream::StreamExt;

        if self.only_full {
            return self.inner.delete_stream(locations);
        }

        let writes = self.writes.clone();
        let survives = self.survives;
        let counted = locations.map(move |location| {
            if writes.fetch_add(1, Ordering::Relaxed) >= survives {
                return Err(killed());
            }
            location
        });
        self.inner.delete_stream(Box::pin(counted))
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        match self.only_full {
            true => self.inner.copy_opts(from, to, options).await,
            false => Err(killed()),
        }
    }
}
