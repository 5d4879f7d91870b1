//! Object stores by URL; S3, Google Cloud Storage and Azure need the feature `cloud`.

use object_store::ObjectStore;
use object_store::path::Path;
use url::Url;

/// Opens the bucket of a URL; the returned path is the URL's prefix. Sends no request. Credentials
/// and endpoints come from the providers' usual environment variables.
///
/// # Errors
/// The reason why it cannot be opened, as text.
#[cfg(feature = "cloud")]
pub fn open(url: &Url) -> Result<(Box<dyn ObjectStore>, Path), String> {
    object_store::parse_url_opts(url, std::env::vars()).map_err(|error| error.to_string())
}

/// Opens URLs that need no bucket, such as `file:` and `memory:`.
///
/// # Errors
/// A message that names the build feature, for any other URL.
#[cfg(not(feature = "cloud"))]
pub fn open(url: &Url) -> Result<(Box<dyn ObjectStore>, Path), String> {
    object_store::parse_url(url).map_err(|error| {
        format!(
            "{error}; for a bucket, build this program with \
             `cargo install --path . --features cloud`"
        )
    })
}
