//! Connections: TCP in the clear or under TLS, and the Unix socket of the server's own workers.
//!
//! 1. Handshakes run beside each other, each with a deadline, and the oldest makes room where there are too many:
//!    peers that are slow or silent delay nobody. Who has said nothing by the deadline is cut off.
//! 2. Certificates are read again when their files change; connections that are open stay open.
//! 3. A connection is read for a short while at a time, then it is the others' turn: what one sends, however much and
//!    whatever it is, keeps the others waiting for one such while at most.
//! 4. On the Unix socket there are only this server's workers: file modes keep others away.

use std::{
    collections::VecDeque,
    fmt, fs, io,
    net::IpAddr,
    net::SocketAddr,
    os::fd::AsRawFd,
    path::{Path, PathBuf},
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream, UnixListener},
    sync::mpsc,
    task::{AbortHandle, JoinSet},
    time::{Sleep, sleep},
};
use tokio_rustls::TlsAcceptor;
use tonic::transport::server::Connected;

use super::{
    crowd::{Crowd, Crowded, Crowding, Place},
    tls::{ServerTls, certificate_names},
};

/// A handshake may take so long.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Handshakes under way at a time.
const MAX_HANDSHAKES: usize = 256;
/// What HTTP of either version begins with has at least so many bytes.
const OPENING: usize = 16;
/// Bytes that are read of a connection before it is the others' turn.
const TURN: usize = 64 << 10;
/// Files that a server has open besides connections, at most: database, objects, logs that are read.
const OWN_FILES: u64 = 1000;
/// After an error of the socket (no more files, say).
const PAUSE: Duration = Duration::from_millis(100);
/// File name of the Unix socket.
pub const SOCKET: &str = "grpc.sock";

/// Who is at the other end.
#[derive(Clone, Debug, Default)]
pub(super) struct Peer {
    address: Option<SocketAddr>,
    /// It came over the socket of the server's own workers.
    pub is_local_worker: bool,
    /// The DNS names and URIs of its certificate, which was verified.
    pub certificate_names: Arc<[String]>,
}

impl Peer {
    /// Its address, unless it is a local worker.
    pub fn ip(&self) -> Option<IpAddr> {
        self.address.map(|address| address.ip())
    }
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.address {
            Some(address) => write!(f, "{address}"),
            None => f.write_str("local"),
        }
    }
}

/// Where connections come from.
#[derive(Debug)]
pub struct Listeners {
    /// For everybody.
    pub tcp: TcpListener,
    /// TLS on the TCP socket.
    pub tls: Option<ServerTls>,
    /// How many may come in on the TCP socket.
    pub crowding: Crowding,
    /// For the server's own workers.
    pub unix: UnixListener,
}

trait Io: AsyncRead + AsyncWrite + Send {}
impl<T: AsyncRead + AsyncWrite + Send> Io for T {}

/// A connection that is ready for HTTP.
pub(super) struct Connection {
    io: Pin<Box<dyn Io>>,
    peer: Peer,
    /// Until the peer has begun to speak HTTP.
    opening: Option<Opening>,
    /// Bytes read in this turn.
    n_read: usize,
    /// On the TCP socket.
    _place: Option<Place>,
}

/// What a peer still has to say, and until when.
struct Opening {
    n_missing: usize,
    deadline: Pin<Box<Sleep>>,
}

impl Default for Opening {
    fn default() -> Self {
        Self { n_missing: OPENING, deadline: Box::pin(sleep(HANDSHAKE)) }
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl Listeners {
    /// Accepts connections for as long as somebody receives them.
    pub(super) async fn accept(self, ready: mpsc::Sender<io::Result<Connection>>) {
        let (mut handshakes, mut under_way) = (JoinSet::new(), VecDeque::new());
        let crowd = Crowd::new(&self.crowding);
        loop {
            tokio::select! {
                () = ready.closed() => return,
                Some(_) = handshakes.join_next() => {}
                tcp = self.tcp.accept() => match tcp {
                    Ok((stream, address)) => match crowd.enter(address.ip(), Instant::now()) {
                        Ok(entered) => {
                            let acceptor = self.tls.as_ref().map(ServerTls::acceptor);
                            let shaken = shake(stream, address, entered, acceptor);
                            make_room(&mut under_way);
                            under_way.push_back(handshakes.spawn(hand_over(shaken, ready.clone())));
                        }
                        Err(crowded) => refused(address, crowded),
                    },
                    Err(error) => pause(&error).await,
                },
                unix = self.unix.accept() => match unix {
                    Ok((stream, _)) => {
                        let peer = Peer { is_local_worker: true, ..Peer::default() };
                        let connection = Connection::new(Box::pin(stream), peer, None);
                        drop(ready.send(Ok(connection)).await);
                    }
                    Err(error) => pause(&error).await,
                },
            }
        }
    }
}

async fn hand_over(
    shaken: impl Future<Output = io::Result<Connection>>,
    ready: mpsc::Sender<io::Result<Connection>>,
) {
    match shaken.await {
        // The server is about to end when nobody receives.
        Ok(connection) => drop(ready.send(Ok(connection)).await),
        Err(error) => tracing::debug!(%error, "no connection"),
    }
}

/// Ends the oldest handshake where there are as many as there may be.
fn make_room(under_way: &mut VecDeque<AbortHandle>) {
    if under_way.len() >= MAX_HANDSHAKES {
        under_way.retain(|handshake| !handshake.is_finished());
    }
    if under_way.len() >= MAX_HANDSHAKES {
        under_way.pop_front().iter().for_each(AbortHandle::abort);
    }
}

fn refused(address: SocketAddr, crowded: Crowded) {
    tracing::debug!(%address, ?crowded, "no connection");
    let why = match crowded {
        Crowded::Fast => "too fast",
        Crowded::ManyOfOne => "too many of one address",
        Crowded::Many => "too many",
    };
    metrics::counter!("lookalike_connections_refused_total", "why" => why).increment(1);
}

async fn pause(error: &io::Error) {
    tracing::warn!(%error, "a connection cannot be accepted");
    tokio::time::sleep(PAUSE).await;
}

async fn shake(
    stream: TcpStream,
    address: SocketAddr,
    (place, wait): (Place, Duration),
    acceptor: Option<TlsAcceptor>,
) -> io::Result<Connection> {
    if !wait.is_zero() {
        sleep(wait).await;
    }
    // Small answers must not wait for the peer's delayed acknowledgement (40 ms).
    stream.set_nodelay(true)?;
    let peer = Peer { address: Some(address), ..Peer::default() };
    let Some(acceptor) = acceptor else {
        return Ok(Connection::new(Box::pin(stream), peer, Some(place)));
    };
    let stream = tokio::time::timeout(HANDSHAKE, acceptor.accept(stream)).await??;
    let certificate = stream.get_ref().1.peer_certificates().and_then(<[_]>::first);
    let certificate_names = certificate.map(certificate_names).unwrap_or_default().into();
    Ok(Connection::new(Box::pin(stream), Peer { certificate_names, ..peer }, Some(place)))
}

impl Connection {
    /// Strangers have a place, and must begin to speak soon.
    fn new(io: Pin<Box<dyn Io>>, peer: Peer, place: Option<Place>) -> Self {
        let opening = place.is_some().then(Opening::default);
        Self { io, peer, opening, n_read: 0, _place: place }
    }
}

/// Lets this process have so many files open, besides what it needs for itself; says how many it may have where those
/// are fewer.
pub fn allow_files(n_connections: usize) -> Result<(), u64> {
    let wanted = OWN_FILES.saturating_add(n_connections as u64);
    let limit = getrlimit(Resource::Nofile);
    let current = limit.maximum.map_or(wanted, |maximum| maximum.min(wanted));
    if limit.current.is_some_and(|now| now < current) {
        let raised = Rlimit { current: Some(current), ..limit };
        setrlimit(Resource::Nofile, raised).map_err(|_| limit.current.unwrap_or(wanted))?;
    }
    if current < wanted { Err(current) } else { Ok(()) }
}

/// Binds the socket of the server's own workers in `folder`, which is closed to everybody else.
pub fn bind_unix(folder: &Path) -> io::Result<UnixListener> {
    use std::os::unix::fs::PermissionsExt;
    let mode = |path: &Path, mode| fs::set_permissions(path, fs::Permissions::from_mode(mode));
    mode(folder, 0o700)?;
    let path = folder.join(SOCKET);
    // Left behind by a server that was killed; the lock of the data directory says that it is gone.
    match fs::remove_file(&path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    // Addresses of Unix sockets are short; the folder's may be long.
    let handle = fs::File::open(folder)?;
    let short: PathBuf = format!("/proc/self/fd/{}/{SOCKET}", handle.as_raw_fd()).into();
    let listener = UnixListener::bind(short)?;
    mode(&path, 0o600)?;
    Ok(listener)
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.n_read >= TURN {
            self.n_read = 0;
            // Woken while it runs, a task goes to the end of the queue.
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        let before = buf.filled().len();
        let polled = self.io.as_mut().poll_read(cx, buf);
        let n_read = buf.filled().len() - before;
        self.n_read = if polled.is_pending() { 0 } else { self.n_read + n_read };
        let Some(opening) = &mut self.opening else { return polled };
        opening.n_missing = opening.n_missing.saturating_sub(n_read);
        if opening.n_missing == 0 {
            self.opening = None;
        } else if polled.is_pending() && opening.deadline.as_mut().poll(cx).is_ready() {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        polled
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.io.as_mut().poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.io.as_mut().poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.io.as_mut().poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.io.as_mut().poll_write_vectored(cx, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }
}
