//! Spans of requests as a collector of OpenTelemetry gets them.

use std::sync::{Arc, Mutex};

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::status::StatusCode;
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::catalog_service_client::CatalogServiceClient;
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::transport::Channel;
use tonic::{Request, Response, Status};

use crate::kills::import;
use crate::program::{Place, until};

/// A collector that keeps what it gets.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<Span>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let spans = request.into_inner().resource_spans.into_iter();
        let spans = spans
            .flat_map(|of_resource| of_resource.scope_spans)
            .flat_map(|of_scope| of_scope.spans);
        self.0.lock().unwrap().extend(spans);
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    /// The span whose parent has this number, once it has arrived.
    fn child_of(&self, parent: [u8; 8]) -> Span {
        let found = || {
            let spans = self.0.lock().unwrap();
            spans
                .iter()
                .find(|span| span.parent_span_id == parent)
                .cloned()
        };
        tokio::task::block_in_place(|| until("the span arrives", || found().is_some()));
        found().unwrap()
    }
}

/// Oracle: W3C Trace Context and OpenTelemetry's own messages: a request that comes with a trace is
/// a span of that trace, below the caller's, with its RPC and how it ended.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_are_spans_of_their_callers_traces() {
    let collector = Collector::default();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let service = TraceServiceServer::new(collector.clone());
    let serving = tonic::transport::Server::builder()
        .add_service(service)
        .serve_with_incoming(TcpListenerStream::new(listener));
    tokio::spawn(serving);

    let here = Place::new();
    here.succeeds(&import(&here, 1, "store"));
    let options = format!("--otlp-endpoint {endpoint}");
    let server = tokio::task::block_in_place(|| here.serve(&options));

    let address = format!("http://{}", server.address);
    let channel = Channel::from_shared(address).unwrap();
    let mut client = CatalogServiceClient::new(channel.connect().await.unwrap());
    let mut ask = async |room: &str, parent: [u8; 8]| {
        let mut request = Request::new(pb::GetRoomRequest {
            room_revision: None,
            room: room.to_owned(),
        });
        let parent = parent.map(|byte| format!("{byte:02x}")).concat();
        let context = format!("00-4bf92f3577b34da6a3ce929d0e0e4736-{parent}-01");
        let metadata = request.metadata_mut();
        metadata.insert("traceparent", context.parse().unwrap());
        client.get_room(request).await.is_ok()
    };
    assert!(ask("a", [1; 8]).await);
    assert!(!ask("nowhere", [2; 8]).await);

    for (parent, status) in [([1; 8], 0), ([2; 8], 5)] {
        let span = collector.child_of(parent);
        let trace = span.trace_id.iter().map(|byte| format!("{byte:02x}"));
        assert_eq!(
            trace.collect::<String>(),
            "4bf92f3577b34da6a3ce929d0e0e4736"
        );
        assert_eq!(span.name, "seese3.v1.CatalogService/GetRoom");
        assert_eq!(span.kind(), SpanKind::Server);
        assert!(span.end_time_unix_nano > span.start_time_unix_nano);

        let mut attributes = span.attributes.iter();
        let code = attributes.find(|attribute| attribute.key == "rpc.grpc.status_code");
        let code = code.and_then(|code| code.value.clone()?.value);
        assert_eq!(code, Some(Value::IntValue(status)));

        // NOT_FOUND is the caller's mistake and no error of the server.
        let code = span.status.unwrap_or_default().code();
        assert_eq!(code, StatusCode::Unset);
    }
}
