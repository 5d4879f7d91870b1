//! A client of the service, in wire types. Error messages are one line.

use std::time::Duration;

use tokio::time::Instant;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::checked_status::CheckedStatus;
use crate::one_line::one_line;

/// Time limit for opening a connection, the TLS handshake included.
const LONGEST_CONNECTING: Duration = Duration::from_secs(10);
/// Time without data after which an open call's connection is tested by a ping.
const SILENCE: Duration = Duration::from_secs(10);
/// Time limit for the answer to a ping. A connection without one is closed, and its calls fail.
const PING_ANSWER: Duration = Duration::from_secs(10);

/// The result of a call that ends until `until`. tonic's own deadline ends with the headers of the
/// response.
pub(crate) async fn in_time<T>(
    until: Instant,
    call: impl Future<Output = Result<T, Status>>,
) -> Result<T, Error> {
    let answer = tokio::time::timeout_at(until, call).await;
    Ok(answer.map_err(|_| Error::Deadline)??)
}

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each variant's message says what it is")]
pub enum Error {
    #[error("'{address}' is no server address: {problem}; write HOST:PORT")]
    Address { address: String, problem: String },
    #[error("cannot connect to {address}: {problem}")]
    Connect { address: String, problem: String },
    #[error("the token must consist of visible ASCII characters")]
    Token,
    #[error("{}", described(.0))]
    Refused(Box<Status>),
    #[error("no response before the deadline")]
    Deadline,
    #[error("the server ended the stream without a result")]
    NoReport,
    #[error("the server's list has no end")]
    EndlessList,
    #[error("the server's download cannot be used: {0}")]
    Download(&'static str),
}

impl Error {
    /// The gRPC code of the server's response; `None` if there was no response.
    pub fn code(&self) -> Option<Code> {
        match self {
            Self::Refused(status) => Some(status.code()),
            _ => None,
        }
    }

    /// The reason of a refusal, as in `google.rpc.ErrorInfo`: one of docs/errors.md.
    pub fn reason(&self) -> Option<String> {
        let Self::Refused(status) = self else {
            return None;
        };
        let details = status.get_error_details();
        details.error_info().map(|info| info.reason.clone())
    }

    /// The invalid request field, if the server reports one.
    pub fn field(&self) -> Option<String> {
        let Self::Refused(status) = self else {
            return None;
        };

        let details = status.get_error_details();
        let violation = details
            .bad_request()
            .and_then(|bad| bad.field_violations.first());
        violation.map(|violation| violation.field.clone())
    }
}

/// What the server refused, or why the connection to it broke: only the client's own transport
/// gives a status a source.
fn described(status: &Status) -> String {
    let Some(mut cause) = std::error::Error::source(status) else {
        let message = one_line(status.message());
        return format!(
            "{message} (refused by the server, {})",
            code_name(status.code())
        );
    };
    while let Some(next) = cause.source() {
        cause = next;
    }
    format!("the connection to the server broke: {cause}")
}

/// The name of a code as in the gRPC documentation, such as `NOT_FOUND` for [`Code::NotFound`].
fn code_name(code: Code) -> String {
    let mut name = String::new();
    for letter in format!("{code:?}").chars() {
        if letter.is_ascii_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.push(letter.to_ascii_uppercase());
    }
    name
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        // The client's own transport reports an expired deadline as a cancellation with this text.
        if status.code() == Code::Cancelled && status.message() == "Timeout expired" {
            return Self::Deadline;
        }

        Self::Refused(Box::new(status))
    }
}

/// The endpoint of an address, HOST:PORT or a URL.
///
/// # Errors
/// [`Error::Address`].
fn endpoint_of(address: &str, has_tls: bool) -> Result<Endpoint, Error> {
    if has_tls && address.starts_with("http://") {
        return Err(Error::Address {
            address: address.to_owned(),
            problem: "http:// is without TLS, but certificates are given".to_owned(),
        });
    }
    let url = match has_tls {
        _ if address.contains("://") => address.to_owned(),
        true => format!("https://{address}"),
        false => format!("http://{address}"),
    };
    let endpoint = Endpoint::from_shared(url).map_err(|error| Error::Address {
        address: address.to_owned(),
        problem: error.to_string(),
    })?;

    // A URL has the port of its scheme; an address without one was typed incompletely.
    if !address.contains("://") && endpoint.uri().port().is_none() {
        return Err(Error::Address {
            address: address.to_owned(),
            problem: "it has no port; the servers' default is 50051".to_owned(),
        });
    }
    Ok(endpoint)
}

/// A connection to a server. Clones are cheap and share the connection.
#[derive(Debug, Clone)]
pub struct Client {
    pub(crate) channel: InterceptedService<CheckedStatus<Channel>, Token>,
    pub(crate) deadline: Duration,
}

/// Options of a connection.
#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// Deadline of every call. For `track`, it limits only the opening of the stream. For
    /// `create_room`, `publish_adapter` and `refit_room`, it limits the time without progress.
    pub deadline: Duration,
    /// Bearer token of every call, if the server requires one.
    pub token: Option<String>,
    /// TLS, if the server uses it.
    pub tls: Option<ClientTls>,
}

/// TLS certificates, PEM.
#[derive(Debug, Clone)]
pub struct ClientTls {
    /// Certificate authorities for the server's certificate.
    pub authorities: Vec<u8>,
    /// The client's certificate and private key, if the server requires one.
    pub identity: Option<(Vec<u8>, Vec<u8>)>,
}

/// Adds the token to every call.
#[derive(Debug, Clone)]
pub(crate) struct Token(pub(crate) Option<MetadataValue<Ascii>>);

impl Interceptor for Token {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, Status> {
        if let Some(authorization) = &self.0 {
            let metadata = request.metadata_mut();
            metadata.insert("authorization", authorization.clone());
        }
        Ok(request)
    }
}

impl Client {
    /// Connects to `address`, HOST:PORT or a URL. For `deadline` see [`ConnectOptions::deadline`].
    ///
    /// # Errors
    /// [`Error::Address`] if the address cannot be parsed, [`Error::Connect`] if there is no
    /// connection within the deadline, at most 10 s.
    pub async fn connect(address: &str, deadline: Duration) -> Result<Self, Error> {
        let options = ConnectOptions {
            deadline,
            token: None,
            tls: None,
        };
        Self::connect_with(address, options).await
    }

    /// Connects to `address`, HOST:PORT or a URL, with a token or TLS.
    ///
    /// # Errors
    /// As [`Client::connect`]; also [`Error::Token`] for an invalid token and [`Error::Connect`]
    /// for invalid certificates.
    pub async fn connect_with(address: &str, options: ConnectOptions) -> Result<Self, Error> {
        let ConnectOptions {
            deadline,
            token,
            tls,
        } = options;

        let token = match token {
            None => None,
            Some(token) => {
                let mut value =
                    MetadataValue::try_from(format!("Bearer {token}")).map_err(|_| Error::Token)?;
                value.set_sensitive(true);
                Some(value)
            }
        };

        let endpoint = endpoint_of(address, tls.is_some())?;
        let within = deadline.min(LONGEST_CONNECTING);
        let mut endpoint = endpoint
            .connect_timeout(within)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(SILENCE)
            .keep_alive_timeout(PING_ANSWER);
        if let Some(tls) = tls {
            let mut config =
                ClientTlsConfig::new().ca_certificate(Certificate::from_pem(tls.authorities));
            if let Some((certificate, key)) = tls.identity {
                config = config.identity(Identity::from_pem(certificate, key));
            }

            endpoint = endpoint
                .tls_config(config)
                .map_err(|error| Error::Connect {
                    address: address.to_owned(),
                    problem: format!("the certificates cannot be used: {error}"),
                })?;
        }

        let failed = |problem| Error::Connect {
            address: address.to_owned(),
            problem,
        };
        // tonic's time limit does not include the TLS handshake.
        let connected = tokio::time::timeout(within, endpoint.connect()).await;
        let connected = connected.map_err(|_| failed("no answer in time".to_owned()))?;
        // tonic's error is only "transport error"; its source has the cause.
        let channel = connected.map_err(|error| {
            let cause = std::error::Error::source(&error);
            let cause = cause.map_or(error.to_string(), ToString::to_string);
            failed(format!(
                "{cause}; is a server running there? `seese3 serve` starts one"
            ))
        })?;

        Ok(Self {
            channel: InterceptedService::new(CheckedStatus(channel), Token(token)),
            deadline,
        })
    }

    /// The result of a call within the deadline.
    pub(crate) async fn in_time<T>(
        &self,
        call: impl Future<Output = Result<T, Status>>,
    ) -> Result<T, Error> {
        in_time(Instant::now() + self.deadline, call).await
    }

    pub(crate) fn request<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        request.set_timeout(self.deadline);
        request
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use super::*;

    /// Oracle: the contract: TLS is not turned off by an address, and no connection is opened then.
    #[tokio::test]
    async fn an_address_does_not_turn_tls_off() {
        let options = ConnectOptions {
            deadline: Duration::from_secs(1),
            token: Some("secret".to_owned()),
            tls: Some(ClientTls {
                authorities: Vec::new(),
                identity: None,
            }),
        };
        let refused = Client::connect_with("http://127.0.0.1:9", options).await;
        assert!(matches!(refused, Err(Error::Address { .. })), "{refused:?}");
    }

    /// Oracle: by hand: nobody listens at the port of HTTP.
    #[tokio::test]
    async fn an_address_needs_a_port() {
        let refused = Client::connect("localhost", Duration::from_secs(1)).await;
        let message = refused.unwrap_err().to_string();
        assert!(message.contains("has no port"), "{message}");
    }

    /// Oracle: the contract: a server's refusal is quoted in one line; a broken connection is no
    /// refusal.
    #[test]
    fn a_broken_connection_is_no_refusal() {
        let refused = Error::from(Status::not_found("no\nroom"));
        assert_eq!(
            refused.to_string(),
            "no room (refused by the server, NOT_FOUND)"
        );

        let cause = std::io::Error::other("the peer is gone");
        let broken = Error::from(Status::from_error(Box::new(cause)));
        assert_eq!(
            broken.to_string(),
            "the connection to the server broke: the peer is gone"
        );
    }
}
