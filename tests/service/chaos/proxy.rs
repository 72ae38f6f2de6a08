//! What a network does to connections: a TCP proxy that refuses, delays, goes silent and cuts, at seeded random
//! moments.

use std::{
    collections::BTreeMap,
    net::SocketAddr,
    sync::{Arc, Mutex},
    time::Duration,
};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{
        TcpListener, TcpStream,
        tcp::{OwnedReadHalf, OwnedWriteHalf},
    },
    task::JoinSet,
    time::{Instant, sleep, timeout_at},
};

use crate::torture::Random;

/// What becomes of a connection, once its time has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Fate {
    /// Reset at once.
    Refused,
    /// Reset in the middle of whatever is said.
    Cut,
    /// Every piece is late, by up to 50 ms; reset at last.
    Slow,
    /// Half open: nothing gets through any more, and nobody is told; reset a few seconds later.
    HalfOpen,
    /// What the client says gets through, what the server answers is lost; then reset.
    Deaf,
}

/// Of ten connections, so many.
const FATES: [(Fate, u64); 5] =
    [(Fate::Refused, 1), (Fate::Cut, 3), (Fate::Slow, 2), (Fate::HalfOpen, 2), (Fate::Deaf, 2)];

impl Fate {
    fn draw(random: &mut Random) -> Self {
        let mut at = random.below(FATES.iter().map(|(_, share)| share).sum());
        let fate = FATES.iter().find(|(_, share)| {
            let here = at < *share;
            at = at.wrapping_sub(*share);
            here
        });
        fate.unwrap().0
    }
}

/// A proxy, as long as it lives.
pub(super) struct Proxy {
    pub(super) url: String,
    fates: Arc<Mutex<BTreeMap<Fate, u64>>>,
    _connections: JoinSet<()>,
}

impl Proxy {
    /// Stands in front of the server at `url`.
    pub(super) async fn start(url: &str, seed: u64) -> Self {
        let server: SocketAddr = url.strip_prefix("http://").unwrap().parse().unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let fates = Arc::<Mutex<BTreeMap<_, _>>>::default();
        let counted = Arc::clone(&fates);
        let mut connections = JoinSet::new();
        connections.spawn(async move {
            let (mut random, mut open) = (Random(seed), JoinSet::new());
            while let Ok((client, _)) = listener.accept().await {
                let fate = Fate::draw(&mut random);
                *counted.lock().unwrap().entry(fate).or_default() += 1;
                open.spawn(suffer(client, server, fate, Random(random.below(u64::MAX))));
                while open.try_join_next().is_some() {}
            }
        });
        Self { url, fates, _connections: connections }
    }

    /// Connections so far, by what became of them.
    pub(super) fn fates(&self) -> BTreeMap<Fate, u64> {
        self.fates.lock().unwrap().clone()
    }
}

/// Carries bytes both ways until the connection's time has come, and for a while after that as its fate says.
async fn suffer(client: TcpStream, server: SocketAddr, fate: Fate, mut random: Random) {
    // A reset, not a farewell.
    client.set_zero_linger().unwrap();
    let Ok(server) = TcpStream::connect(server).await else { return };
    server.set_zero_linger().unwrap();
    let (from_client, to_client) = client.into_split();
    let (from_server, to_server) = server.into_split();
    let mut within =
        |least: u64, most: u64| Duration::from_millis(least + random.below(most - least));
    let (calm, after) = match fate {
        Fate::Refused => return,
        Fate::Cut => (within(20, 3000), Duration::ZERO),
        Fate::Slow => (within(1000, 6000), Duration::ZERO),
        Fate::HalfOpen => (within(20, 2000), within(500, 4000)),
        Fate::Deaf => (within(20, 2000), within(200, 1000)),
    };
    let most_late = if fate == Fate::Slow { 50 } else { 0 };
    let (trouble, end) = (Instant::now() + calm, Instant::now() + calm + after);
    let requests_until = if fate == Fate::Deaf { end } else { trouble };
    let late = [(); 2].map(|()| Random(random.below(u64::MAX)));
    let [late_requests, late_replies] = late;
    let requests = carry(from_client, to_server, requests_until, (late_requests, most_late));
    let replies = carry(from_server, to_client, trouble, (late_replies, most_late));
    // The halves that come back stay open until the end.
    let _halves = tokio::join!(requests, replies);
    tokio::time::sleep_until(end).await;
}

/// Carries bytes until a moment, or the end of the stream.
async fn carry(
    mut from: OwnedReadHalf,
    mut to: OwnedWriteHalf,
    until: Instant,
    (mut random, most_late): (Random, u64),
) -> (OwnedReadHalf, OwnedWriteHalf) {
    let mut piece = vec![0; 16 << 10];
    while let Ok(Ok(n @ 1..)) = timeout_at(until, from.read(&mut piece)).await {
        if most_late > 0 {
            sleep(Duration::from_millis(random.below(most_late))).await;
        }
        // A full pipe must not keep a connection beyond its time.
        if !matches!(timeout_at(until, to.write_all(&piece[..n])).await, Ok(Ok(()))) {
            break;
        }
    }
    (from, to)
}
