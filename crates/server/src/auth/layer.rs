//! Checks every request before decoding it.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use http::{HeaderMap, Request, Response, header};
use tokio::sync::OwnedSemaphorePermit;
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};

use super::super::Error;
use super::super::connections::{Owner, Peer};
use super::super::health::{HEALTH_CHECK, HEALTH_WATCH};
use super::super::holding_body::holding;
use super::super::metrics::Metrics;
use super::super::rpcs::rpc;
use super::super::status::Full;
use super::{Keyring, Principal, Verb};

/// The verb that an RPC requires, by path prefix; the first match counts.
const VERBS: [(&str, Need); 11] = [
    // Container and load balancer probes have no token.
    (HEALTH_CHECK, Need::Nothing),
    (HEALTH_WATCH, Need::Nothing),
    ("/grpc.reflection.", Need::Verb(Verb::Catalog)),
    ("/seese3.v1.NavigationService/", Need::Verb(Verb::Navigate)),
    (
        "/seese3.v1.LocalizationService/",
        Need::Verb(Verb::Localize),
    ),
    ("/seese3.v1.OdometryService/", Need::Verb(Verb::Track)),
    ("/seese3.v1.EvaluationService/", Need::Verb(Verb::Evaluate)),
    ("/seese3.v1.CatalogService/List", Need::Verb(Verb::Catalog)),
    ("/seese3.v1.CatalogService/Get", Need::Verb(Verb::Catalog)),
    (
        "/seese3.v1.CatalogService/Download",
        Need::Verb(Verb::Download),
    ),
    // All other catalog RPCs are changes.
    ("/seese3.v1.CatalogService/", Need::Verb(Verb::Write)),
];

/// The permission that an RPC requires.
#[derive(Debug, Clone, Copy)]
enum Need {
    Nothing,
    Verb(Verb),
}

/// Resources held until the response has ended.
struct Admitted {
    /// The caller's request permit.
    _place: OwnedSemaphorePermit,
    /// Keeps the limits of a signed token's subject alive: they are dropped with its last
    /// principal.
    _principal: Arc<Principal>,
}

/// The principal of an admitted call, as the owner of its connection.
#[derive(Debug)]
struct ConnectionOwner {
    keyring: Arc<Keyring>,
    principal: Arc<Principal>,
}

impl Owner for ConnectionOwner {
    fn name(&self) -> Arc<str> {
        self.principal.shared_name()
    }

    fn is_valid(&self) -> bool {
        self.keyring.is_valid(&self.principal)
    }
}

/// Middleware that admits only authenticated callers, if there are credentials.
#[derive(Debug, Clone)]
pub struct AuthLayer {
    /// The credentials; `None` to admit every caller.
    pub keyring: Option<Arc<Keyring>>,
    /// Counts requests rejected at a caller's concurrency limit.
    pub metrics: Metrics,
}

impl<S> Layer<S> for AuthLayer {
    type Service = Auth<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Auth {
            inner,
            layer: self.clone(),
        }
    }
}

/// A service wrapped by [`AuthLayer`].
#[derive(Debug, Clone)]
pub struct Auth<S> {
    inner: S,
    layer: AuthLayer,
}

impl<S, B> Service<Request<B>> for Auth<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<B>) -> Self::Future {
        let admitted = match self.layer.admit(&mut request) {
            Ok(admitted) => admitted,
            Err(error) => {
                let refused = Status::from(error).into_http();
                return Box::pin(async move { Ok(refused) });
            }
        };
        let answer = self.inner.call(request);

        Box::pin(async move {
            let response = answer.await?;
            Ok(match admitted {
                None => response,
                Some(admitted) => response.map(|body| holding(body, admitted)),
            })
        })
    }
}

impl AuthLayer {
    /// Authenticates and authorizes a request, and stores its principal in the request's
    /// extensions. `None` if the RPC or the server requires no authentication.
    fn admit<B>(&self, request: &mut Request<B>) -> Result<Option<Admitted>, Error> {
        let path = request.uri().path();
        let is_known = rpc(path).is_some();
        let Some(keyring) = &self.keyring else {
            return is_known.then_some(None).ok_or(Error::UnknownPath);
        };

        let mut needs = VERBS.iter();
        let need = needs.find(|(beginning, _)| path.starts_with(beginning));
        let verb = match need {
            Some((_, Need::Nothing)) if is_known => return Ok(None),
            Some((_, Need::Verb(verb))) => Some(*verb),
            Some((_, Need::Nothing)) | None => None,
        };

        let principal = caller(keyring, request)?;
        tracing::Span::current().record("principal", principal.name());

        // Without credentials, all unknown paths are refused above as unauthenticated.
        if !is_known {
            return Err(Error::UnknownPath);
        }

        // An RPC without a verb is refused, so that a new service cannot be open by mistake.
        let verb = verb.ok_or(Error::UnknownPath)?;
        if !principal.may(verb) {
            return Err(Error::Forbidden { verb: verb.into() });
        }

        let full = Full::CallersRequests;
        let place = principal.request_place().ok_or_else(|| {
            self.metrics.shed(full);
            Error::Full { what: full }
        })?;
        if let Some(peer) = request.extensions().get::<Peer>() {
            let owner = ConnectionOwner {
                keyring: keyring.clone(),
                principal: principal.clone(),
            };
            if !peer.assign(Arc::new(owner)) {
                let full = Full::CallersConnections;
                self.metrics.shed(full);
                return Err(Error::Full { what: full });
            }
        }
        request.extensions_mut().insert(principal.clone());

        Ok(Some(Admitted {
            _place: place,
            _principal: principal,
        }))
    }
}

/// The caller of a request. A token takes precedence over a certificate, because the certificate
/// may belong to a gateway shared by many callers.
fn caller<B>(keyring: &Keyring, request: &Request<B>) -> Result<Arc<Principal>, Error> {
    let credentials = keyring.current();

    if let Some(token) = bearer(request.headers())? {
        return credentials.by_token(token);
    }

    let peer = request.extensions().get::<Peer>();
    let certificate = peer.and_then(|peer| peer.certificate);
    certificate
        .and_then(|certificate| credentials.by_certificate(&certificate))
        .ok_or(Error::Unauthenticated {
            problem: "a token is needed, as metadata `authorization: Bearer TOKEN`",
        })
}

/// The bearer token of a request (RFC 6750, section 2.1); `None` without an `authorization` header.
fn bearer(headers: &HeaderMap) -> Result<Option<&[u8]>, Error> {
    let Some(given) = headers.get(header::AUTHORIZATION) else {
        return Ok(None);
    };

    let malformed = Error::Unauthenticated {
        problem: "the metadata `authorization` must be `Bearer TOKEN`",
    };
    let (scheme, token) = given
        .as_bytes()
        .split_at_checked(7)
        .ok_or(malformed.clone())?;
    if !scheme.eq_ignore_ascii_case(b"Bearer ") || token.is_empty() {
        return Err(malformed);
    }

    Ok(Some(token))
}

#[cfg(all(test, feature = "jwt"))]
mod tests {
    use super::*;
    use std::convert::Infallible;

    /// Oracle: the limit in the auth file. A token's calls count until they are answered, even
    /// after the request body is dropped.
    #[tokio::test]
    async fn calls_of_one_subject_are_bounded() {
        let golden =
            std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/jwt");
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("auth.toml");
        std::fs::copy(golden.join("p256.pem"), folder.path().join("login.pem")).unwrap();
        let issuer = "[[issuer]]\nissuer = \"https://login.example.org\"\naudience = \"seese3\"\n\
                      public_keys = [\"login.pem\"]\nverbs = [\"navigate\"]\nrooms = [\"*\"]\nrequests = 2\n";
        std::fs::write(&file, issuer).unwrap();
        let tokens = std::fs::read(golden.join("tokens.json")).unwrap();
        let tokens: serde_json::Value = serde_json::from_slice(&tokens).unwrap();
        let token = tokens["good"]["ES256"].as_str().unwrap();

        let layer = AuthLayer {
            keyring: Some(Arc::new(Keyring::open(file).unwrap())),
            metrics: Metrics::default(),
        };
        let mut service = layer.layer(tower::service_fn(|request: Request<()>| {
            drop(request);
            std::future::pending::<Result<Response<Body>, Infallible>>()
        }));
        let mut call = || {
            let request = Request::builder()
                .uri("/seese3.v1.NavigationService/Navigate")
                .header(header::AUTHORIZATION, format!("Bearer {token}"));
            service.call(request.body(()).unwrap())
        };

        let open = [call(), call()];
        let soon = std::time::Duration::from_millis(500);
        let refused = tokio::time::timeout(soon, call()).await;
        let refused = refused.expect("the call is rejected immediately").unwrap();
        assert_eq!(refused.headers()["grpc-status"], "8");

        // Canceled calls free their permits.
        drop(open);
        let answered = tokio::time::timeout(soon, call()).await;
        assert!(answered.is_err(), "the call is admitted and never answered");
    }
}
