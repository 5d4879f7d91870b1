//! A client of the service, in wire types. Error messages are one line.

use std::time::Duration;

use tokio_stream::Stream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Code, Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_types::StatusExt;

use crate::proto::v1 as pb;
use crate::proto::v1::catalog_service_client::CatalogServiceClient;
use crate::proto::v1::evaluation_service_client::EvaluationServiceClient;
use crate::proto::v1::localization_service_client::LocalizationServiceClient;
use crate::proto::v1::navigation_service_client::NavigationServiceClient;
use crate::proto::v1::odometry_service_client::OdometryServiceClient;

/// Maximum size of a response, bytes.
const MESSAGE_BYTES: usize = 64 << 20;

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
    #[error("the server refused ({:?}): {}", .0.code(), .0.message())]
    Refused(Box<Status>),
    #[error("no response before the deadline")]
    Deadline,
    #[error("the server ended the stream without a result")]
    NoReport,
}

impl Error {
    /// The gRPC code of the server's response; `None` if there was no response.
    pub fn code(&self) -> Option<Code> {
        match self {
            Self::Refused(status) => Some(status.code()),
            _ => None,
        }
    }

    /// The invalid request field, if the server reports one.
    pub fn field(&self) -> Option<String> {
        let Self::Refused(status) = self else {
            return None;
        };

        // An invalid value is reported in `BadRequest`, an unknown name in `ResourceInfo` with the
        // field as its type.
        let details = status.get_error_details();
        let violation = details
            .bad_request()
            .and_then(|bad| bad.field_violations.first());

        let resource = details
            .resource_info()
            .map(|resource| resource.resource_type.clone());

        violation
            .map(|violation| violation.field.clone())
            .or(resource)
    }
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

/// A connection to a server. Clones are cheap and share the connection.
#[derive(Debug, Clone)]
pub struct Client {
    channel: InterceptedService<Channel, Token>,
    deadline: Duration,
}

/// Options of a connection.
#[derive(Debug, Clone)]
pub struct ConnectOptions {
    /// Deadline of every call, except `create_room`, `publish_adapter` and `refit_room`, which have
    /// none. For `track`, it limits only the opening of the stream.
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
struct Token(Option<MetadataValue<Ascii>>);

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

        let url = match &tls {
            _ if address.contains("://") => address.to_owned(),
            Some(_) => format!("https://{address}"),
            None => format!("http://{address}"),
        };
        let endpoint = Endpoint::from_shared(url).map_err(|error| Error::Address {
            address: address.to_owned(),
            problem: error.to_string(),
        })?;

        let mut endpoint = endpoint
            .connect_timeout(deadline.min(Duration::from_secs(10)))
            .tcp_nodelay(true);
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

        // tonic's error is only "transport error"; its source has the cause.
        let channel = endpoint.connect().await.map_err(|error| {
            let cause =
                std::error::Error::source(&error).map_or(error.to_string(), ToString::to_string);
            Error::Connect {
                address: address.to_owned(),
                problem: cause,
            }
        })?;

        Ok(Self {
            channel: InterceptedService::new(channel, Token(token)),
            deadline,
        })
    }

    /// Navigates from a view by a motion.
    ///
    /// # Errors
    /// [`Error::Refused`] if the server refuses the request, [`Error::Deadline`] without a response
    /// in time. This holds for every call.
    pub async fn navigate(
        &self,
        request: pb::NavigateRequest,
    ) -> Result<pb::NavigateResponse, Error> {
        let mut service = NavigationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(service.navigate(self.request(request)).await?.into_inner())
    }

    /// Several navigation requests in one call. Results are in the order of the requests.
    ///
    /// # Errors
    /// [`Error::Refused`] if the whole batch is refused. The failure of a single request is part of
    /// the results.
    pub async fn batch_navigate(
        &self,
        requests: Vec<pb::NavigateRequest>,
    ) -> Result<Vec<pb::BatchNavigateResult>, Error> {
        let mut service = NavigationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(service
            .batch_navigate(self.request(pb::BatchNavigateRequest { requests }))
            .await?
            .into_inner()
            .results)
    }

    /// Navigates to a goal. `feedback` is called for each feedback message.
    ///
    /// # Errors
    /// [`Error::Refused`], or [`Error::NoReport`] if the stream ends without a result.
    pub async fn navigate_to(
        &self,
        request: pb::NavigateToRequest,
        mut feedback: impl FnMut(pb::NavigateToFeedback),
    ) -> Result<pb::NavigateToResult, Error> {
        let mut service = NavigationServiceClient::new(self.channel.clone());
        let mut events = service
            .navigate_to(self.request(request))
            .await?
            .into_inner();

        while let Some(pb::NavigateToResponse { event }) = events.message().await? {
            match event {
                Some(pb::navigate_to_response::Event::Result(result)) => return Ok(result),
                Some(pb::navigate_to_response::Event::Feedback(step)) => feedback(step),
                None => {}
            }
        }

        Err(Error::NoReport)
    }

    /// The stored frames most similar to a view, with their poses.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn localize(
        &self,
        request: pb::LocalizeRequest,
    ) -> Result<pb::LocalizeResponse, Error> {
        let mut service = LocalizationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(service.localize(self.request(request)).await?.into_inner())
    }

    /// The rooms ranked by their match with the given views, and the pose in each.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn relocalize(
        &self,
        request: pb::RelocalizeRequest,
    ) -> Result<pb::RelocalizeResponse, Error> {
        let mut service = LocalizationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(service
            .relocalize(self.request(request))
            .await?
            .into_inner())
    }

    /// Estimates the motion between two views.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn estimate_motion(
        &self,
        request: pb::EstimateMotionRequest,
    ) -> Result<pb::EstimateMotionResponse, Error> {
        let mut service = OdometryServiceClient::new(self.channel.clone());
        Ok(service
            .estimate_motion(self.request(request))
            .await?
            .into_inner())
    }

    /// Computes the latents of views.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn encode(&self, request: pb::EncodeRequest) -> Result<pb::EncodeResponse, Error> {
        let mut service = OdometryServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(service.encode(self.request(request)).await?.into_inner())
    }

    /// Opens a tracking stream: sends `requests` as they are produced and returns the stream of
    /// responses. The deadline applies until the server accepts the first request, the
    /// configuration. The stream itself has no deadline, because it lasts as long as the robot
    /// moves.
    ///
    /// # Errors
    /// [`Error::Refused`] if the stream cannot be opened, [`Error::Deadline`] without a response in
    /// time. Later errors are items of the stream.
    pub async fn track(
        &self,
        requests: impl Stream<Item = pb::TrackRequest> + Send + 'static,
    ) -> Result<Streaming<pb::TrackResponse>, Error> {
        let mut service = OdometryServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let opened = tokio::time::timeout(self.deadline, service.track(requests)).await;
        Ok(opened.map_err(|_| Error::Deadline)??.into_inner())
    }

    /// All frames of a room, read page by page. `neighbours_within` adds to each frame its
    /// neighbors within this motion norm, meters and radians mixed. `thumbnail_width` adds a JPEG
    /// of this width, pixels, if the server provides images.
    ///
    /// # Errors
    /// [`Error::Refused`], also if the room changes between two pages.
    pub async fn frames(
        &self,
        room: &str,
        neighbours_within: Option<f64>,
        thumbnail_width: Option<u32>,
    ) -> Result<Vec<pb::RoomFrame>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let mut frames = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = self.request(pb::ListFramesRequest {
                room: room.to_owned(),
                page_size: 0,
                page_token,
                neighbours_within,
                thumbnail_width,
            });
            let page = service.list_frames(request).await?.into_inner();
            frames.extend(page.frames);

            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(frames);
            }
        }
    }

    /// All rooms, read page by page.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn rooms(&self) -> Result<Vec<pb::Room>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let mut rooms = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = self.request(pb::ListRoomsRequest {
                page_size: 0,
                page_token,
            });
            let page = service.list_rooms(request).await?.into_inner();
            rooms.extend(page.rooms);

            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(rooms);
            }
        }
    }

    /// One room, by name.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn room(&self, room: &str) -> Result<Option<pb::Room>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        Ok(service
            .get_room(self.request(pb::GetRoomRequest {
                room: room.to_owned(),
            }))
            .await?
            .into_inner()
            .room)
    }

    /// All adapters, read page by page.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn adapters(&self) -> Result<Vec<pb::Adapter>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let mut adapters = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = self.request(pb::ListAdaptersRequest {
                page_size: 0,
                page_token,
            });
            let page = service.list_adapters(request).await?.into_inner();
            adapters.extend(page.adapters);

            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(adapters);
            }
        }
    }

    /// One adapter, by name.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn adapter(&self, adapter: &str) -> Result<Option<pb::Adapter>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let request = self.request(pb::GetAdapterRequest {
            adapter: adapter.to_owned(),
        });

        Ok(service.get_adapter(request).await?.into_inner().adapter)
    }

    /// Publishes a room from a `RoomUpload`, batches of frames and an `UploadEnd`, in this order.
    /// The client sets no deadline.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn create_room(
        &self,
        messages: impl Stream<Item = pb::CreateRoomRequest> + Send + 'static,
    ) -> Result<pb::CreateRoomResponse, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        Ok(service.create_room(messages).await?.into_inner())
    }

    /// Publishes an externally trained adapter from an `AdapterUpload` and its weights, in this
    /// order. The client sets no deadline.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn publish_adapter(
        &self,
        messages: impl Stream<Item = pb::PublishAdapterRequest> + Send + 'static,
    ) -> Result<pb::PublishAdapterResponse, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        Ok(service.publish_adapter(messages).await?.into_inner())
    }

    /// Fits an adapter to a room on the server. `progress` is called for each progress message. The
    /// client sets no deadline: a fit takes minutes.
    ///
    /// # Errors
    /// [`Error::Refused`], or [`Error::NoReport`] if the stream ends without a result.
    pub async fn refit_room(
        &self,
        request: pb::RefitRoomRequest,
        mut progress: impl FnMut(pb::RefitProgress),
    ) -> Result<pb::RefitResult, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let mut events = service.refit_room(request).await?.into_inner();
        while let Some(pb::RefitRoomResponse { event }) = events.message().await? {
            match event {
                Some(pb::refit_room_response::Event::Result(result)) => return Ok(result),
                Some(pb::refit_room_response::Event::Progress(step)) => progress(step),
                None => {}
            }
        }

        Err(Error::NoReport)
    }

    /// Sets or clears the default revision of a name or the default adapter of a room. Returns all
    /// current defaults.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn set_default(
        &self,
        request: pb::SetDefaultRequest,
    ) -> Result<Vec<pb::Default>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = service.set_default(self.request(request)).await?;
        Ok(answer.into_inner().defaults)
    }

    /// Undoes the last change of a default. Returns all current defaults.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn roll_back_default(
        &self,
        request: pb::RollBackDefaultRequest,
    ) -> Result<Vec<pb::Default>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = service.roll_back_default(self.request(request)).await?;
        Ok(answer.into_inner().defaults)
    }

    /// Deletes a room or one of its revisions. Returns the deleted revisions.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn delete_room(&self, request: pb::DeleteRoomRequest) -> Result<Vec<u64>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = service.delete_room(self.request(request)).await?;
        Ok(answer.into_inner().revisions)
    }

    /// Deletes an adapter or one of its revisions. Returns the deleted revisions.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn delete_adapter(
        &self,
        request: pb::DeleteAdapterRequest,
    ) -> Result<Vec<u64>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = service.delete_adapter(self.request(request)).await?;
        Ok(answer.into_inner().revisions)
    }

    /// Evaluates navigators on a room's test pairs. `progress` is called at the start of each
    /// navigator.
    ///
    /// # Errors
    /// [`Error::Refused`], or [`Error::NoReport`] if the stream ends without a report.
    pub async fn evaluate(
        &self,
        request: pb::EvaluateRequest,
        mut progress: impl FnMut(pb::EvaluationProgress),
    ) -> Result<pb::EvaluationReport, Error> {
        let mut service = EvaluationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let mut events = service.evaluate(self.request(request)).await?.into_inner();
        while let Some(pb::EvaluateResponse { event }) = events.message().await? {
            match event {
                Some(pb::evaluate_response::Event::Report(report)) => return Ok(report),
                Some(pb::evaluate_response::Event::Progress(step)) => progress(step),
                None => {}
            }
        }

        Err(Error::NoReport)
    }

    /// Scores external predictions.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn score_predictions(
        &self,
        request: pb::ScorePredictionsRequest,
    ) -> Result<pb::ScorePredictionsResponse, Error> {
        let mut service = EvaluationServiceClient::new(self.channel.clone());
        Ok(service
            .score_predictions(self.request(request))
            .await?
            .into_inner())
    }

    /// Health check: whether `name` is SERVING. `name` is `""` for the whole server, the full name
    /// of a service, or `rooms/NAME`.
    ///
    /// # Errors
    /// [`Error::Refused`], also for an unknown name.
    pub async fn serves(&self, name: &str) -> Result<bool, Error> {
        let mut health = HealthClient::new(self.channel.clone());
        let request = self.request(HealthCheckRequest {
            service: name.to_owned(),
        });

        Ok(health.check(request).await?.into_inner().status() == ServingStatus::Serving)
    }

    fn request<T>(&self, message: T) -> tonic::Request<T> {
        let mut request = tonic::Request::new(message);
        request.set_timeout(self.deadline);
        request
    }
}
