//! Buckets of S3, Google Cloud Storage and Azure, with the feature `cloud`.

use object_store::ObjectStore;
use object_store::path::Path;
use url::Url;

/// Opens the bucket of a URL; the path is the prefix in the URL. Sends no request. Credentials and endpoints
/// are read from the providers' usual environment variables.
///
/// # Errors
/// Why it cannot be opened.
#[cfg(feature = "cloud")]
pub fn open(url: &Url) -> Result<(Box<dyn ObjectStore>, Path), String> {
    object_store::parse_url_opts(url, std::env::vars()).map_err(|error| error.to_string())
}

/// Opens what needs no bucket, such as `file:` and `memory:`.
///
/// # Errors
/// That this program was built without buckets.
#[cfg(not(feature = "cloud"))]
pub fn open(url: &Url) -> Result<(Box<dyn ObjectStore>, Path), String> {
    object_store::parse_url(url).map_err(|error| {
        format!(
            "{error}; for a bucket, build this program with \
             `cargo install --path . --features cloud`"
        )
    })
}
