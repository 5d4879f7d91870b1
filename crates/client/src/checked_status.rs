//! Removes malformed error details from responses.
//!
//! tonic 0.14 panics if `grpc-status-details-bin` is not base64. The header comes from the server.

use std::pin::Pin;
use std::task::{Context, Poll};

use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use http_body::{Frame, SizeHint};
use tonic::body::Body;
use tonic::codegen::{BoxFuture, Service, http};

/// The header, or trailer, of a status's details.
const DETAILS: &str = "grpc-status-details-bin";
/// Base64 with or without padding, as gRPC allows.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// A connection without malformed error details.
#[derive(Debug, Clone)]
pub struct CheckedStatus<S>(pub S);

impl<S> Service<http::Request<Body>> for CheckedStatus<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = S::Error;
    type Future = BoxFuture<Self::Response, S::Error>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let answer = self.0.call(request);
        Box::pin(async move {
            let mut response = answer.await?;
            remove_malformed(response.headers_mut());
            Ok(response.map(|body| Body::new(CheckedBody(body))))
        })
    }
}

/// A response body without malformed error details in its trailers.
struct CheckedBody(Body);

impl http_body::Body for CheckedBody {
    type Data = <Body as http_body::Body>::Data;
    type Error = tonic::Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        Pin::new(&mut self.0)
            .poll_frame(context)
            .map_ok(|mut frame| {
                if let Some(trailers) = frame.trailers_mut() {
                    remove_malformed(trailers);
                }
                frame
            })
    }

    fn is_end_stream(&self) -> bool {
        self.0.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.0.size_hint()
    }
}

fn remove_malformed(headers: &mut http::HeaderMap) {
    let details = headers.get(DETAILS);
    if details.is_some_and(|details| BASE64.decode(details).is_err()) {
        headers.remove(DETAILS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: RFC 4648: four characters are three bytes, three are two bytes without their
    /// padding, and one is none.
    #[test]
    fn only_malformed_details_are_removed() {
        for (details, is_kept) in [
            ("Zm9v", true),
            ("Zm8", true),
            ("Zm8=", true),
            ("!!!!", false),
            ("Z", false),
        ] {
            let mut headers = http::HeaderMap::new();
            headers.insert(DETAILS, http::HeaderValue::from_static(details));
            remove_malformed(&mut headers);
            assert_eq!(headers.contains_key(DETAILS), is_kept, "{details}");
        }
    }
}
