//! Accepts connections, with a limit on their number and on the time to open one.
//!
//! | file | what |
//! | --- | --- |
//! | `owners` | divides the connections among callers |
//!
//! tonic accepts any number of connections and keeps those that never send a byte. Here each
//! accepted connection takes a permit. Within a time limit it must finish the TLS handshake and
//! send as many bytes as the HTTP/2 preface has. Only then is it passed to tonic, which checks the
//! bytes.

mod owners;

pub use owners::Owner;

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use sha2::{Digest, Sha256};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::futures::OwnedNotified;
use tokio::sync::{AcquireError, Notify, OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::JoinSet;
use tokio::task::coop::unconstrained;
use tokio_rustls::server::TlsStream;
use tokio_stream::Stream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;

use super::metrics::Metrics;
use super::status::Full;
use super::tls::Tls;
use owners::{Entry, Owners};

/// Length of the HTTP/2 connection preface (RFC 9113, section 3.4), bytes.
const PREFACE: usize = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".len();
/// Time limit for the TLS handshake and the preface.
const OPENING: Duration = Duration::from_secs(10);
/// Maximum number of concurrent health calls of a connection. They need no credentials.
const MOST_HEALTH_CALLS: usize = 8;
/// Pause after `accept` failed, for instance because the process reached its limit of open files.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// The client side of a connection.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Number of the connection, unique in this process.
    pub id: u64,
    /// The remote address.
    pub address: SocketAddr,
    /// SHA-256 of the verified client certificate, if the server requires one.
    pub certificate: Option<[u8; 32]>,
    /// Places of the connection's health calls.
    health: Arc<Semaphore>,
    closing: Arc<Closing>,
    /// Its entry among the connections; `None` on a server without credentials.
    entry: Option<Arc<Entry>>,
}

/// The close signal of a connection.
#[derive(Debug, Default)]
struct Closing {
    asked: AtomicBool,
    /// Notified when the connection is to be closed.
    now: Arc<Notify>,
}

impl Peer {
    /// A place for one more health call of the connection; `None` at the limit.
    pub fn health_place(&self) -> Option<OwnedSemaphorePermit> {
        self.health.clone().try_acquire_owned().ok()
    }

    /// Closes the connection and all its streams. Returns true on the first call only.
    pub fn close(&self) -> bool {
        self.closing.close()
    }

    /// Makes the caller of an admitted call the owner of the connection, see [`owners`]. Returns
    /// false if the caller may own no further connection.
    pub fn assign(&self, owner: Arc<dyn Owner>) -> bool {
        let entry = self.entry.as_ref();
        entry.is_none_or(|entry| entry.assign(owner))
    }
}

impl Closing {
    /// Asks for the connection to be closed. Returns true on the first call only.
    fn close(&self) -> bool {
        self.now.notify_one();
        !self.asked.swap(true, Ordering::Relaxed)
    }

    #[cfg(test)]
    fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }
}

/// An open connection. Dropping it first removes its entry and then releases its place: a new
/// connection would wait in vain for the place of an entry that has none any more.
pub struct Connection {
    transport: Transport,
    /// The bytes read while the connection was opened; the cursor is how many tonic has read.
    preface: io::Cursor<[u8; PREFACE]>,
    peer: Peer,
    /// Completes when the connection is to be closed.
    closed: Pin<Box<OwnedNotified>>,
    _place: OwnedSemaphorePermit,
}

enum Transport {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

/// The shared state for opening connections.
#[derive(Clone)]
struct Opener {
    places: Arc<Semaphore>,
    last_id: Arc<AtomicU64>,
    /// Ownership of the connections; `None` on a server without credentials.
    owners: Option<Arc<Owners>>,
    tls: Option<Arc<Tls>>,
    metrics: Metrics,
}

type AcquiredPlace = Result<OwnedSemaphorePermit, AcquireError>;

/// The place of a new connection.
enum Place {
    Free(AcquiredPlace),
    /// That of a connection that is being closed. The first that waits gets it.
    Awaited(Pin<Box<dyn Future<Output = AcquiredPlace> + Send>>),
}

impl Place {
    /// A free place, or a place in the queue.
    fn of(places: &Arc<Semaphore>) -> Self {
        // When the cooperative budget of the task is used up, a poll returns Pending even though a
        // place is free. Then another connection would be closed for it.
        let mut place = Box::pin(unconstrained(places.clone().acquire_owned()));
        let mut context = Context::from_waker(Waker::noop());
        match place.as_mut().poll(&mut context) {
            Poll::Ready(free) => Self::Free(free),
            Poll::Pending => Self::Awaited(place),
        }
    }
}

/// How connections are accepted.
pub struct Acceptance {
    /// Maximum number of connections.
    pub most: usize,
    /// Whether calls are authenticated. Then connections are divided among callers, see [`owners`];
    /// otherwise new ones are closed at the limit.
    pub has_credentials: bool,
    /// The certificate; `None` for plain text.
    pub tls: Option<Arc<Tls>>,
    /// Counts closed connections.
    pub metrics: Metrics,
}

/// Stream of the connections that `listener` accepts. Dropping the stream drops the listener and
/// the connections being opened.
pub fn incoming(
    listener: TcpListener,
    acceptance: Acceptance,
) -> impl Stream<Item = io::Result<Connection>> {
    let Acceptance {
        most,
        has_credentials,
        tls,
        metrics,
    } = acceptance;
    let opener = Opener {
        places: Arc::new(Semaphore::new(most)),
        last_id: Arc::default(),
        owners: has_credentials.then(|| Owners::new(most)),
        tls,
        metrics,
    };
    let (opened, stream) = mpsc::channel(1);
    tokio::spawn(accept_all(listener, opener, opened));

    ReceiverStream::new(stream)
}

async fn accept_all(
    listener: TcpListener,
    opener: Opener,
    opened: mpsc::Sender<io::Result<Connection>>,
) {
    let mut opening = JoinSet::new();

    // A condition that persists is logged once.
    let mut is_refused = false;
    let mut is_full = false;

    loop {
        while opening.try_join_next().is_some() {}

        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = opened.closed() => return,
        };
        let (tcp, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                if !is_refused {
                    tracing::error!(%error, "cannot accept connections");
                }
                is_refused = true;
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        is_refused = false;

        // The place is waited for before a connection is closed, so that no later one gets it.
        let place = Place::of(&opener.places);
        let is_awaited = matches!(place, Place::Awaited(_));
        if is_awaited {
            opener.metrics.shed(Full::Connections);
            if !is_full {
                tracing::warn!(
                    "connection limit reached: closing the oldest unowned connection for each new one, or the \
                     new one if none is unowned"
                );
            }
            let owners = opener.owners.as_ref();
            if !owners.is_some_and(|owners| owners.close_oldest()) {
                is_full = true;
                continue;
            }
        }
        is_full = is_awaited;

        let peer = opener.peer(address);
        let opener = opener.clone();
        let opened = opened.clone();
        opening.spawn(async move {
            let closing = peer.closing.clone();
            let connection = async {
                let place = match place {
                    Place::Free(place) => place,
                    Place::Awaited(place) => place.await,
                };
                let place = place.map_err(io::Error::other)?;
                opener.open(tcp, place, peer).await
            };
            let connection = tokio::select! {
                connection = tokio::time::timeout(OPENING, connection) => connection,
                () = closing.now.notified() => return,
            };
            match connection {
                // `send` fails if the server is stopping.
                Ok(Ok(connection)) => drop(opened.send(Ok(connection)).await),
                Ok(Err(error)) => tracing::debug!(%address, %error, "opening a connection failed"),
                Err(_) => tracing::debug!(%address, "opening a connection timed out"),
            }
        });
    }
}

impl Opener {
    /// A new connection, without a certificate yet.
    fn peer(&self, address: SocketAddr) -> Peer {
        let id = self.last_id.fetch_add(1, Ordering::Relaxed);
        let closing = Arc::<Closing>::default();
        let owners = self.owners.as_ref();
        let entry = owners.map(|owners| Arc::new(owners.add(id, closing.clone())));

        Peer {
            id,
            address,
            certificate: None,
            health: Arc::new(Semaphore::new(MOST_HEALTH_CALLS)),
            closing,
            entry,
        }
    }

    /// Performs the TLS handshake, if any, and reads the preface.
    async fn open(
        &self,
        tcp: TcpStream,
        // Dropped after the peer, see `Connection`.
        place: OwnedSemaphorePermit,
        mut peer: Peer,
    ) -> io::Result<Connection> {
        tcp.set_nodelay(true)?;

        let mut transport = match &self.tls {
            None => Transport::Plain(tcp),
            Some(tls) => {
                let stream = tls.acceptor().accept(tcp).await?;
                let chain = stream.get_ref().1.peer_certificates();
                peer.certificate = chain
                    .and_then(|chain| chain.first())
                    .map(|first| Sha256::digest(first).into());
                Transport::Tls(Box::new(stream))
            }
        };

        let mut preface = [0; PREFACE];
        match &mut transport {
            Transport::Plain(stream) => stream.read_exact(&mut preface).await?,
            Transport::Tls(stream) => stream.read_exact(&mut preface).await?,
        };

        Ok(Connection {
            transport,
            preface: io::Cursor::new(preface),
            closed: Box::pin(peer.closing.now.clone().notified_owned()),
            peer,
            _place: place,
        })
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        // Requests in progress may still hold the entry.
        if let Some(entry) = &self.peer.entry {
            entry.remove();
        }
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl Connection {
    /// Fails once the connection is to be closed, even if the peer blocks reads and writes.
    fn check_open(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        match self.closed.as_mut().poll(context) {
            Poll::Ready(()) => Err(io::ErrorKind::ConnectionAborted.into()),
            Poll::Pending => Ok(()),
        }
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check_open(context)?;

        let read = self.preface.position() as usize;
        let rest = &self.preface.get_ref()[read..];

        if !rest.is_empty() {
            let count = rest.len().min(buffer.remaining());
            buffer.put_slice(&rest[..count]);
            self.preface.set_position((read + count) as u64);
            return Poll::Ready(Ok(()));
        }

        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_read(context, buffer),
            Transport::Tls(stream) => Pin::new(stream).poll_read(context, buffer),
        }
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.check_open(context)?;
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write(context, bytes),
            Transport::Tls(stream) => Pin::new(stream).poll_write(context, bytes),
        }
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check_open(context)?;
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_write_vectored(context, slices),
            Transport::Tls(stream) => Pin::new(stream).poll_write_vectored(context, slices),
        }
    }

    fn is_write_vectored(&self) -> bool {
        match &self.transport {
            Transport::Plain(stream) => stream.is_write_vectored(),
            Transport::Tls(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check_open(context)?;
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_flush(context),
            Transport::Tls(stream) => Pin::new(stream).poll_flush(context),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.transport {
            Transport::Plain(stream) => Pin::new(stream).poll_shutdown(context),
            Transport::Tls(stream) => Pin::new(stream).poll_shutdown(context),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::task::Wake;

    use futures_util::FutureExt;
    use tokio::task::coop::{consume_budget, has_budget_remaining};

    use super::*;

    /// Oracle: the contract: connections get places in the order of their arrival, and free places
    /// at once, also where the task that accepts them has used up its budget.
    #[tokio::test]
    async fn places_are_given_in_the_order_of_arrival() {
        let accept = tokio::spawn(async {
            let places = Arc::new(Semaphore::new(1));
            while has_budget_remaining() {
                consume_budget().now_or_never();
            }

            let Place::Free(Ok(first)) = Place::of(&places) else {
                panic!("one place is free");
            };
            let Place::Awaited(mut second) = Place::of(&places) else {
                panic!("no place is free");
            };
            let Place::Awaited(mut third) = Place::of(&places) else {
                panic!("no place is free");
            };

            drop(first);
            assert!((&mut third).now_or_never().is_none());
            let second = (&mut second).now_or_never();
            assert!(matches!(second, Some(Ok(_))));
            drop(second);
            assert!(matches!(third.now_or_never(), Some(Ok(_))));
        });
        accept.await.unwrap();
    }

    /// Looks for an entry at the moment when a place becomes free.
    struct AtRelease {
        owners: Arc<Owners>,
        had_entry: Mutex<Option<bool>>,
    }

    impl Wake for AtRelease {
        fn wake(self: Arc<Self>) {
            *self.had_entry.lock().unwrap() = Some(self.owners.close_oldest());
        }
    }

    /// Whether the only entry is still there when the only place becomes free by `ends`, a
    /// connection that ends.
    async fn has_entry_at_release<E: Future>(
        ends: impl FnOnce(Opener, Peer, OwnedSemaphorePermit) -> E,
    ) -> bool {
        let owners = Owners::new(1);
        let opener = Opener {
            places: Arc::new(Semaphore::new(1)),
            last_id: Arc::default(),
            owners: Some(owners.clone()),
            tls: None,
            metrics: Metrics::default(),
        };
        let place = opener.places.clone().acquire_owned().await.unwrap();
        let mut next = Box::pin(opener.places.clone().acquire_owned());
        let waker = Arc::new(AtRelease {
            owners,
            had_entry: Mutex::default(),
        });
        let peer = opener.peer(([127, 0, 0, 1], 1).into());
        let polled = next
            .as_mut()
            .poll(&mut Context::from_waker(&waker.clone().into()));
        assert!(polled.is_pending());

        ends(opener, peer, place).await;
        waker.had_entry.lock().unwrap().expect("the place is free")
    }

    async fn sent(bytes: &[u8]) -> TcpStream {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap())
            .await
            .unwrap();
        tokio::io::AsyncWriteExt::write_all(&mut client, bytes)
            .await
            .unwrap();
        listener.accept().await.unwrap().0
    }

    /// Oracle: the contract: the place of an entry that is closed becomes free afterwards, however
    /// the connection ends.
    #[tokio::test]
    async fn an_entry_ends_before_its_place() {
        let fails = has_entry_at_release(|opener, peer, place| async move {
            assert!(opener.open(sent(b"PRI").await, place, peer).await.is_err());
        });
        assert!(!fails.await);

        let ends = has_entry_at_release(|opener, peer, place| async move {
            let request = peer.clone();
            let opened = opener.open(sent(&[0; PREFACE]).await, place, peer).await;
            drop(opened.unwrap());
            drop(request);
        });
        assert!(!ends.await);
    }
}
