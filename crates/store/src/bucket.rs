//! Object stores by URL; S3, Google Cloud Storage and Azure need the feature `cloud`.

use object_store::ObjectStore;
use object_store::path::Path;
use url::Url;

/// Environment variables that configure a provider, as (name, value).
pub type Variables = [(String, String)];

/// Opens the bucket of a URL; the returned path is the URL's prefix. Sends no request. Credentials
/// and endpoints come from the providers' usual environment variables, `variables`. Failed requests
/// are repeated.
///
/// # Errors
/// The reason why it cannot be opened, as text.
#[cfg(feature = "cloud")]
pub fn open(url: &Url, variables: &Variables) -> Result<(Box<dyn ObjectStore>, Path), String> {
    cloud::open(url, variables).map_err(|error| error.to_string())
}

/// Opens URLs that need no bucket, such as `file:` and `memory:`.
///
/// # Errors
/// A message that names the build feature, for any other URL.
#[cfg(not(feature = "cloud"))]
pub fn open(url: &Url, _: &Variables) -> Result<(Box<dyn ObjectStore>, Path), String> {
    object_store::parse_url(url).map_err(|error| {
        format!(
            "{error}; for a bucket, build this program with \
             `cargo install --path . --features cloud`"
        )
    })
}

#[cfg(feature = "cloud")]
mod cloud {
    use std::str::FromStr;
    use std::time::Duration;

    use object_store::aws::AmazonS3Builder;
    use object_store::azure::MicrosoftAzureBuilder;
    use object_store::gcp::GoogleCloudStorageBuilder;
    use object_store::path::Path;
    use object_store::{ClientOptions, ObjectStore, ObjectStoreScheme, RetryConfig};
    use url::Url;

    use super::Variables;

    /// Time from a request's start after which it is not repeated: one that timed out is repeated
    /// once. The pauses are random, from 0.1 s on.
    const RETRIED: Duration = Duration::from_secs(90);
    /// Not reached: a request that fails at once is repeated about 100 times in that time.
    const REPETITIONS: usize = 10_000;
    /// Time limit for connecting.
    const CONNECTING: Duration = Duration::from_secs(5);
    /// Time limit for one request and its answer: an object of 1 GB needs 17 MB/s.
    const REQUEST: Duration = Duration::from_secs(60);

    pub fn open(
        url: &Url,
        variables: &Variables,
    ) -> Result<(Box<dyn ObjectStore>, Path), object_store::Error> {
        let (scheme, prefix) = ObjectStoreScheme::parse(url)?;
        // A refused connection takes no time: ten repetitions, the default, last a few seconds.
        let retry = RetryConfig {
            max_retries: REPETITIONS,
            retry_timeout: RETRIED,
            ..RetryConfig::default()
        };
        let client = ClientOptions::new()
            .with_connect_timeout(CONNECTING)
            .with_timeout(REQUEST);

        let objects: Box<dyn ObjectStore> = match scheme {
            ObjectStoreScheme::AmazonS3 => {
                let plain = AmazonS3Builder::new().with_client_options(client);
                let keys = known(variables, &["aws_"]);
                let builder = keys.fold(plain, |to, (key, value)| to.with_config(key, value));
                Box::new(builder.with_url(url.as_str()).with_retry(retry).build()?)
            }
            ObjectStoreScheme::GoogleCloudStorage => {
                // As the builder's own options.
                let client = client.with_allow_http(true);
                let plain = GoogleCloudStorageBuilder::new().with_client_options(client);
                let keys = known(variables, &["google_", "service_account"]);
                let builder = keys.fold(plain, |to, (key, value)| to.with_config(key, value));
                Box::new(builder.with_url(url.as_str()).with_retry(retry).build()?)
            }
            ObjectStoreScheme::MicrosoftAzure => {
                let plain = MicrosoftAzureBuilder::new().with_client_options(client);
                let keys = known(variables, &["azure_", "identity_endpoint"]);
                let builder = keys.fold(plain, |to, (key, value)| to.with_config(key, value));
                Box::new(builder.with_url(url.as_str()).with_retry(retry).build()?)
            }
            _ => return object_store::parse_url(url),
        };
        Ok((objects, prefix))
    }

    /// The settings of a provider among some variables, by the beginnings of their names in lower
    /// case.
    fn known<K: FromStr>(
        variables: &Variables,
        beginnings: &[&str],
    ) -> impl Iterator<Item = (K, String)> {
        variables.iter().filter_map(|(name, value)| {
            let name = name.to_ascii_lowercase();
            let is_ours = beginnings
                .iter()
                .any(|beginning| name.starts_with(beginning));
            Some((name.parse().ok().filter(|_| is_ours)?, value.clone()))
        })
    }
}
