//! Response bodies that hold a resource, such as a permit or a memory lease, until they are sent.

use std::pin::Pin;
use std::task::{Context, Poll};

use http_body::{Frame, SizeHint};
use tonic::body::Body;

/// A body and a value that is dropped with it.
struct HoldingBody<H> {
    body: Body,
    _held: H,
}

/// Wraps `body` so that `held` is dropped with it.
pub fn holding<H: Send + Unpin + 'static>(body: Body, held: H) -> Body {
    Body::new(HoldingBody { body, _held: held })
}

impl<H: Unpin> http_body::Body for HoldingBody<H> {
    type Data = <Body as http_body::Body>::Data;
    type Error = <Body as http_body::Body>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
