//! The calls of a client.

use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::time::Instant;
use tokio_stream::{Stream, StreamExt as _};
use tonic::{Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::client::{Client, Error, in_time};
use crate::proto::v1 as pb;
use crate::proto::v1::catalog_service_client::CatalogServiceClient;
use crate::proto::v1::evaluation_service_client::EvaluationServiceClient;
use crate::proto::v1::localization_service_client::LocalizationServiceClient;
use crate::proto::v1::navigation_service_client::NavigationServiceClient;
use crate::proto::v1::odometry_service_client::OdometryServiceClient;

/// Maximum number of pages of a list. A server's page has up to 1,000 entries.
const MOST_PAGES: usize = 10_000;
/// Maximum size of a response, bytes.
const MESSAGE_BYTES: usize = 64 << 20;

/// The time at which the connection took the last message of an upload.
#[derive(Debug, Clone)]
struct LastTaken(Arc<Mutex<Instant>>);

impl LastTaken {
    fn get(&self) -> Instant {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set_now(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }
}

/// The messages of an upload, and the time at which the connection took the last one.
fn observed<M: Send + 'static>(
    messages: impl Stream<Item = M> + Send + 'static,
) -> (impl Stream<Item = M> + Send + 'static, LastTaken) {
    let last_taken = LastTaken(Arc::new(Mutex::new(Instant::now())));
    let taken = last_taken.clone();
    let messages = messages.map(move |message| {
        taken.set_now();
        message
    });
    (messages, last_taken)
}

/// The pages of a list.
#[derive(Debug, Default)]
struct Pages {
    count: usize,
    token: String,
}

impl Pages {
    /// Goes on to the page of `token`. Returns whether there is one.
    ///
    /// # Errors
    /// [`Error::EndlessList`] if the list has no end: a token that comes twice in a row, or more
    /// than [`MOST_PAGES`].
    fn go_on(&mut self, token: String) -> Result<bool, Error> {
        if token.is_empty() {
            return Ok(false);
        }
        self.count += 1;
        if token == self.token || self.count == MOST_PAGES {
            return Err(Error::EndlessList);
        }
        self.token = token;
        Ok(true)
    }
}

/// The largest weights of a downloaded adapter, bytes.
const LARGEST_WEIGHTS: usize = 1 << 30;

impl Client {
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
        Ok(self
            .in_time(service.navigate(self.request(request)))
            .await?
            .into_inner())
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
        Ok(self
            .in_time(service.batch_navigate(self.request(pb::BatchNavigateRequest { requests })))
            .await?
            .into_inner()
            .results)
    }

    /// Several localization requests in one call. Results are in the order of the requests.
    ///
    /// # Errors
    /// [`Error::Refused`] if the whole batch is refused. The failure of a single request is part of
    /// the results.
    pub async fn batch_localize(
        &self,
        requests: Vec<pb::LocalizeRequest>,
    ) -> Result<Vec<pb::BatchLocalizeResult>, Error> {
        let mut service = LocalizationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(self
            .in_time(service.batch_localize(self.request(pb::BatchLocalizeRequest { requests })))
            .await?
            .into_inner()
            .results)
    }

    /// Plans a route to a goal.
    ///
    /// # Errors
    /// [`Error::Refused`] or [`Error::Deadline`].
    pub async fn plan_route(&self, request: pb::PlanRouteRequest) -> Result<pb::Route, Error> {
        let mut service = NavigationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(self
            .in_time(service.plan_route(self.request(request)))
            .await?
            .into_inner())
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
        Ok(self
            .in_time(service.localize(self.request(request)))
            .await?
            .into_inner())
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
        Ok(self
            .in_time(service.relocalize(self.request(request)))
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
        Ok(self
            .in_time(service.estimate_motion(self.request(request)))
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
        Ok(self
            .in_time(service.encode(self.request(request)))
            .await?
            .into_inner())
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
        Ok(self.in_time(service.track(requests)).await?.into_inner())
    }

    /// All frames of a room, read page by page. `neighbors_within` adds to each frame its
    /// neighbors within this motion norm, meters and radians mixed. `thumbnail_width` adds a JPEG
    /// of this width, pixels, if the server provides images.
    ///
    /// # Errors
    /// [`Error::Refused`], also if the room changes between two pages; [`Error::EndlessList`].
    pub async fn frames(
        &self,
        room: &str,
        neighbors_within: Option<f64>,
        thumbnail_width: Option<u32>,
    ) -> Result<Vec<pb::RoomFrame>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let mut frames = Vec::new();
        let mut pages = Pages::default();
        loop {
            let request = self.request(pb::ListFramesRequest {
                room_revision: None,
                room: room.to_owned(),
                page_size: 0,
                page_token: pages.token.clone(),
                neighbors_within,
                thumbnail_width,
            });
            let page = self
                .in_time(service.list_frames(request))
                .await?
                .into_inner();
            frames.extend(page.frames);

            if !pages.go_on(page.next_page_token)? {
                return Ok(frames);
            }
        }
    }

    /// All rooms, read page by page.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::EndlessList`].
    pub async fn rooms(&self) -> Result<Vec<pb::Room>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let mut rooms = Vec::new();
        let mut pages = Pages::default();
        loop {
            let request = self.request(pb::ListRoomsRequest {
                page_size: 0,
                page_token: pages.token.clone(),
            });
            let page = self
                .in_time(service.list_rooms(request))
                .await?
                .into_inner();
            rooms.extend(page.rooms);

            if !pages.go_on(page.next_page_token)? {
                return Ok(rooms);
            }
        }
    }

    /// The version, the abilities and the limits of the server.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn server_info(&self) -> Result<pb::ServerInfo, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let request = self.request(pb::GetServerInfoRequest {});
        Ok(self
            .in_time(service.get_server_info(request))
            .await?
            .into_inner())
    }

    /// The current revision of a room, by name.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn room(&self, room: &str) -> Result<pb::Room, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let request = self.request(pb::GetRoomRequest {
            room: room.to_owned(),
            room_revision: None,
        });
        Ok(self.in_time(service.get_room(request)).await?.into_inner())
    }

    /// A room's frames, features and keypoints. `take` is called for each message; its error ends
    /// the download.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::Deadline`] if no message comes for as long as the deadline, or
    /// the error of `take`.
    pub async fn download_room<E: From<Error>>(
        &self,
        request: pb::DownloadRoomRequest,
        mut take: impl FnMut(pb::DownloadRoomResponse) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut service = CatalogServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let opened = self.in_time(service.download_room(request)).await?;
        let mut messages = opened.into_inner();
        while let Some(message) = self.in_time(messages.message()).await? {
            take(message)?;
        }
        Ok(())
    }

    /// An adapter's manifest and weights, with its revision.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::Deadline`] if no message comes for as long as the deadline, or
    /// [`Error::NoReport`] if the stream has no manifest, [`Error::Download`] if its messages are not
    /// in order, or its weights are larger than 1 GiB.
    pub async fn download_adapter(
        &self,
        request: pb::DownloadAdapterRequest,
    ) -> Result<(pb::AdapterDownload, Vec<u8>), Error> {
        use pb::download_adapter_response::Message;

        let mut service = CatalogServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        let opened = self.in_time(service.download_adapter(request)).await?;
        let mut messages = opened.into_inner();
        let (mut adapter, mut weights) = (None, Vec::new());
        while let Some(received) = self.in_time(messages.message()).await? {
            match received.message {
                Some(Message::Adapter(first)) if adapter.is_none() => adapter = Some(first),
                Some(Message::Weights(part)) if adapter.is_some() && !part.is_empty() => {
                    weights.extend(part);
                }
                _ => return Err(Error::Download("its messages are not in order")),
            }
            if weights.len() > LARGEST_WEIGHTS {
                return Err(Error::Download("its weights are larger than 1 GiB"));
            }
        }
        Ok((adapter.ok_or(Error::NoReport)?, weights))
    }

    /// All defaults that were set.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn defaults(&self) -> Result<Vec<pb::CatalogDefault>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let request = self.request(pb::ListDefaultsRequest {});
        let answer = self.in_time(service.list_defaults(request)).await?;
        Ok(answer.into_inner().defaults)
    }

    /// All adapters, read page by page.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::EndlessList`].
    pub async fn adapters(&self) -> Result<Vec<pb::Adapter>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let mut adapters = Vec::new();
        let mut pages = Pages::default();
        loop {
            let request = self.request(pb::ListAdaptersRequest {
                page_size: 0,
                page_token: pages.token.clone(),
            });
            let page = self
                .in_time(service.list_adapters(request))
                .await?
                .into_inner();
            adapters.extend(page.adapters);

            if !pages.go_on(page.next_page_token)? {
                return Ok(adapters);
            }
        }
    }

    /// The current revision of an adapter, by name.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn adapter(&self, adapter: &str) -> Result<pb::Adapter, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let request = self.request(pb::GetAdapterRequest {
            adapter: adapter.to_owned(),
            adapter_revision: None,
        });

        Ok(self
            .in_time(service.get_adapter(request))
            .await?
            .into_inner())
    }

    /// Publishes a room from a `RoomUpload`, batches of frames and an `UploadEnd`, in this order.
    ///
    /// # Errors
    /// [`Error::Refused`]; [`Error::Deadline`] if the connection takes no message for as long as
    /// the deadline, or there is no response within it after the last one. The room may then still
    /// be published.
    pub async fn upload_room(
        &self,
        messages: impl Stream<Item = pb::UploadRoomRequest> + Send + 'static,
    ) -> Result<pb::UploadRoomResponse, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let (messages, last_taken) = observed(messages);
        self.uploaded(service.upload_room(messages), last_taken)
            .await
    }

    /// Publishes an externally trained adapter from an `AdapterUpload` and its weights, in this
    /// order.
    ///
    /// # Errors
    /// As [`Client::upload_room`].
    pub async fn upload_adapter(
        &self,
        messages: impl Stream<Item = pb::UploadAdapterRequest> + Send + 'static,
    ) -> Result<pb::UploadAdapterResponse, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let (messages, last_taken) = observed(messages);
        self.uploaded(service.upload_adapter(messages), last_taken)
            .await
    }

    /// Fits an adapter to a room on the server. `progress` is called for each progress message; the
    /// server sends one every second, also while the fit waits for its turn.
    ///
    /// # Errors
    /// [`Error::Refused`], [`Error::Deadline`] if no message comes for as long as the deadline, or
    /// [`Error::NoReport`] if the stream ends without a result.
    pub async fn fit_adapter(
        &self,
        request: pb::FitAdapterRequest,
        mut progress: impl FnMut(pb::FitProgress),
    ) -> Result<pb::FitResult, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let opened = self.in_time(service.fit_adapter(request)).await?;
        let mut events = opened.into_inner();
        while let Some(pb::FitAdapterResponse { event }) = self.in_time(events.message()).await? {
            match event {
                Some(pb::fit_adapter_response::Event::Result(result)) => return Ok(result),
                Some(pb::fit_adapter_response::Event::Progress(step)) => progress(step),
                None => {}
            }
        }

        Err(Error::NoReport)
    }

    /// Sets the default revision of a room or an adapter, or the default adapter of a room. Returns
    /// all current defaults.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn set_default(
        &self,
        request: pb::SetDefaultRequest,
    ) -> Result<Vec<pb::CatalogDefault>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = self
            .in_time(service.set_default(self.request(request)))
            .await?;
        Ok(answer.into_inner().defaults)
    }

    /// Clears a default. Returns all current defaults.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn clear_default(
        &self,
        request: pb::ClearDefaultRequest,
    ) -> Result<Vec<pb::CatalogDefault>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = self
            .in_time(service.clear_default(self.request(request)))
            .await?;
        Ok(answer.into_inner().defaults)
    }

    /// Deletes a room or one of its revisions. Returns the deleted revisions.
    ///
    /// # Errors
    /// [`Error::Refused`].
    pub async fn delete_room(&self, request: pb::DeleteRoomRequest) -> Result<Vec<u64>, Error> {
        let mut service = CatalogServiceClient::new(self.channel.clone());
        let answer = self
            .in_time(service.delete_room(self.request(request)))
            .await?;
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
        let answer = self
            .in_time(service.delete_adapter(self.request(request)))
            .await?;
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
        let until = Instant::now() + self.deadline;
        let opened = in_time(until, service.evaluate(self.request(request))).await?;
        let mut events = opened.into_inner();
        while let Some(pb::EvaluateResponse { event }) = in_time(until, events.message()).await? {
            match event {
                Some(pb::evaluate_response::Event::Report(report)) => return Ok(report),
                Some(pb::evaluate_response::Event::Progress(step)) => progress(step),
                None => {}
            }
        }

        Err(Error::NoReport)
    }

    /// The pairs and the candidate frames of a split.
    ///
    /// # Errors
    /// [`Error::Refused`] or [`Error::Deadline`].
    pub async fn list_pairs(
        &self,
        request: pb::ListPairsRequest,
    ) -> Result<pb::ListPairsResponse, Error> {
        let mut service = EvaluationServiceClient::new(self.channel.clone())
            .max_decoding_message_size(MESSAGE_BYTES);
        Ok(self
            .in_time(service.list_pairs(self.request(request)))
            .await?
            .into_inner())
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
        Ok(self
            .in_time(service.score_predictions(self.request(request)))
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

        Ok(self
            .in_time(health.check(request))
            .await?
            .into_inner()
            .status()
            == ServingStatus::Serving)
    }

    /// The response to an upload, within the deadline after each message that the connection takes.
    async fn uploaded<A>(
        &self,
        call: impl Future<Output = Result<tonic::Response<A>, Status>>,
        last_taken: LastTaken,
    ) -> Result<A, Error> {
        let mut answer = pin!(call);
        loop {
            let last = last_taken.get();
            match tokio::time::timeout_at(last + self.deadline, &mut answer).await {
                Ok(answer) => return Ok(answer?.into_inner()),
                Err(_) if last_taken.get() > last => {}
                Err(_) => return Err(Error::Deadline),
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failed step is a failed test")]
mod tests {
    use std::time::Duration;

    use tonic::service::interceptor::InterceptedService;
    use tonic::transport::Endpoint;

    use super::*;
    use crate::checked_status::CheckedStatus;
    use crate::client::Token;

    /// Oracle: the contract: no call waits longer than its deadline for a server that says nothing,
    /// an upload of many messages included.
    #[tokio::test]
    async fn a_silent_server_is_given_up() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let deadline = Duration::from_millis(200);
        let client = Client::connect(&address, deadline).await.unwrap();

        let frames = pb::FrameBatch {
            poses: vec![0; 1 << 20],
            ..pb::FrameBatch::default()
        };
        let message = Some(pb::upload_room_request::Message::Frames(frames));
        let messages = vec![pb::UploadRoomRequest { message }; 100];
        let upload = client.upload_room(tokio_stream::iter(messages)).await;
        assert!(matches!(upload, Err(Error::Deadline)), "{upload:?}");
        let upload = client.upload_adapter(tokio_stream::iter([])).await;
        assert!(matches!(upload, Err(Error::Deadline)), "{upload:?}");
        let fit = client
            .fit_adapter(pb::FitAdapterRequest::default(), |_| ())
            .await;
        assert!(matches!(fit, Err(Error::Deadline)), "{fit:?}");
        let stream = client.track(tokio_stream::iter([])).await;
        assert!(
            matches!(stream, Err(Error::Deadline)),
            "{:?}",
            stream.map(drop)
        );
        let call = client.navigate(pb::NavigateRequest::default()).await;
        assert!(matches!(call, Err(Error::Deadline)), "{call:?}");
    }

    /// Oracle: the contract: a list ends at its last page, and one whose token comes again has no
    /// end.
    #[test]
    fn a_list_without_an_end_is_refused() {
        let mut pages = Pages::default();
        assert!(matches!(pages.go_on("1".to_owned()), Ok(true)));
        assert!(matches!(pages.go_on("2".to_owned()), Ok(true)));
        assert!(matches!(pages.go_on(String::new()), Ok(false)));
        assert!(matches!(
            pages.go_on("2".to_owned()),
            Err(Error::EndlessList)
        ));

        let mut pages = Pages::default();
        let ends = (0..MOST_PAGES).map(|page| pages.go_on(page.to_string()).is_err());
        assert_eq!(ends.filter(|ends| *ends).count(), 1);
    }

    /// Oracle: the contract: an upload that goes on may take longer than the deadline.
    #[tokio::test(start_paused = true)]
    async fn an_upload_that_goes_on_is_not_given_up() {
        let deadline = Duration::from_secs(1);
        let client = Client {
            channel: InterceptedService::new(
                CheckedStatus(Endpoint::from_static("http://127.0.0.1:9").connect_lazy()),
                Token(None),
            ),
            deadline,
        };
        let (messages, last_taken) = observed(tokio_stream::iter(0..10));
        let mut messages = pin!(messages);
        let call = async {
            while messages.next().await.is_some() {
                tokio::time::sleep(deadline * 9 / 10).await;
            }
            Ok(tonic::Response::new(7))
        };
        assert!(matches!(client.uploaded(call, last_taken).await, Ok(7)));

        let (_messages, last_taken) = observed(tokio_stream::iter([0]));
        let call = std::future::pending::<Result<tonic::Response<()>, Status>>();
        let given_up = client.uploaded(call, last_taken).await;
        assert!(matches!(given_up, Err(Error::Deadline)));
    }
}
