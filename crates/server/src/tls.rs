//! TLS with certificate files, which are reloaded when they change.

use super::slow_files::read_logged_if_slow;
use seese3_core::Cause;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use sha2::{Digest, Sha256};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};

/// Interval for checking the files for changes.
const LOOK: Duration = Duration::from_secs(5);

/// The files of a server's certificate, in PEM.
#[derive(Debug, Clone)]
pub struct TlsFiles {
    /// The server's certificate chain, its own certificate first.
    pub cert: PathBuf,
    /// The private key of the first certificate.
    pub key: PathBuf,
    /// The authorities for client certificates; `None` if clients need no certificate.
    pub client_ca: Option<PathBuf>,
}

/// An error in the TLS files.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum TlsError {
    #[error("{option}: {} cannot be read: {problem}", file.display())]
    Unreadable {
        option: &'static str,
        file: PathBuf,
        #[source]
        problem: std::io::Error,
    },
    #[error("{option}: {} contains no {what} in PEM", file.display())]
    Empty {
        option: &'static str,
        file: PathBuf,
        what: &'static str,
    },
    #[error("--tls-cert, --tls-key or --tls-client-ca: {0}")]
    Unfit(#[source] Cause),
}

/// The TLS configuration of a server, reloaded from its files.
#[derive(Debug)]
pub struct Tls {
    files: TlsFiles,
    /// SHA-256 of the files' content at startup.
    opened: [u8; 32],
    current: RwLock<Arc<ServerConfig>>,
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`TlsError`], naming the option.
    pub fn open(files: TlsFiles) -> Result<Self, TlsError> {
        let (config, opened) = read(&files)?;
        Ok(Self {
            files,
            opened,
            current: RwLock::new(Arc::new(config)),
        })
    }

    /// An acceptor with the current certificate.
    pub fn acceptor(&self) -> TlsAcceptor {
        let current = self.current.read();
        TlsAcceptor::from(current.unwrap_or_else(PoisonError::into_inner).clone())
    }

    /// Polls the files and reloads them when they change; never completes. New connections use the
    /// new certificate. Inconsistent files, for instance during replacement, are logged and
    /// ignored.
    pub async fn follow_files(&self) {
        let mut seen = Some(self.opened);
        let mut trouble = String::new();

        loop {
            tokio::time::sleep(LOOK).await;

            let files = self.files.clone();
            let found = read_logged_if_slow("the certificate files", move || read(&files));
            let Ok(found) = found.await else {
                return;
            };
            match found {
                Ok((config, digest)) => {
                    trouble.clear();
                    if seen.replace(digest) != Some(digest) {
                        let current = self.current.write();
                        *current.unwrap_or_else(PoisonError::into_inner) = Arc::new(config);
                        tracing::info!("the certificate was replaced");
                    }
                }
                Err(error) if error.to_string() != trouble => {
                    trouble = error.to_string();
                    tracing::error!(%error, "the new certificate is not usable; the previous one stays in use");
                }
                Err(_) => {}
            }
        }
    }
}

/// Reads the files: the TLS configuration and a SHA-256 of their content.
fn read(files: &TlsFiles) -> Result<(ServerConfig, [u8; 32]), TlsError> {
    let TlsFiles {
        cert,
        key,
        client_ca,
    } = files;
    let mut digest = Sha256::new();
    let mut content = |option, file: &Path| {
        let bytes =
            seese3_files::read(file, seese3_files::SMALL_FILE_BYTES).map_err(|problem| {
                TlsError::Unreadable {
                    option,
                    file: file.to_owned(),
                    problem,
                }
            })?;
        digest.update((bytes.len() as u64).to_le_bytes());
        digest.update(&bytes);
        Ok(bytes)
    };

    let chain = certificates("--tls-cert", cert, &content("--tls-cert", cert)?)?;
    let private = content("--tls-key", key)?;
    let private = PrivateKeyDer::from_pem_slice(&private).map_err(|_| TlsError::Empty {
        option: "--tls-key",
        file: key.clone(),
        what: "private key",
    })?;

    let provider = Arc::new(ring::default_provider());
    let builder = ServerConfig::builder_with_provider(provider.clone())
        .with_safe_default_protocol_versions()
        .map_err(|error| TlsError::Unfit(error.into()))?;

    let builder = match client_ca {
        None => builder.with_no_client_auth(),
        Some(file) => {
            let option = "--tls-client-ca";
            let mut roots = RootCertStore::empty();
            for authority in certificates(option, file, &content(option, file)?)? {
                roots
                    .add(authority)
                    .map_err(|error| TlsError::Unfit(error.into()))?;
            }

            let verifier =
                WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
            builder
                .with_client_cert_verifier(verifier.map_err(|error| TlsError::Unfit(error.into()))?)
        }
    };

    let mut config = builder
        .with_single_cert(chain, private)
        .map_err(|error| TlsError::Unfit(error.into()))?;
    config.alpn_protocols = vec![b"h2".to_vec()];

    Ok((config, digest.finalize().into()))
}

fn certificates(
    option: &'static str,
    file: &Path,
    content: &[u8],
) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let all: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(content).collect();

    match all {
        Ok(all) if !all.is_empty() => Ok(all),
        _ => Err(TlsError::Empty {
            option,
            file: file.to_owned(),
            what: "certificate",
        }),
    }
}
