//! HTTP/2 by hand, for what no sound client sends.

use std::{
    io,
    net::{Ipv4Addr, SocketAddr},
    time::Duration,
};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{TcpSocket, TcpStream},
    time::timeout,
};

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RST_STREAM: u8 = 3;
const SETTINGS: u8 = 4;
const GOAWAY: u8 = 7;
const WINDOW_UPDATE: u8 = 8;
const CONTINUATION: u8 = 9;
const END_HEADERS: u8 = 4;
/// `POST http:///`, all from HPACK's static table.
const POST: [u8; 3] = [0x83, 0x86, 0x84];

/// How a server ended a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// With this error code of HTTP/2.
    GoAway(u32),
    /// Without one.
    Closed,
    /// Not at all.
    Open,
}

fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let mut frame = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    frame.extend([kind, flags]);
    frame.extend(stream.to_be_bytes());
    frame.extend(payload);
    frame
}

fn opening() -> Vec<u8> {
    [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &frame(SETTINGS, 0, 0, &[])[..]].concat()
}

/// Calls that are taken back as soon as they are made (CVE-2023-44487).
pub(crate) fn reset_flood(n_calls: u32) -> Vec<u8> {
    let call = |i: u32| {
        let stream = 2 * i + 1;
        [frame(HEADERS, END_HEADERS, stream, &POST), frame(RST_STREAM, 0, stream, &[0, 0, 0, 8])]
    };
    [opening(), (0..n_calls).flat_map(call).flatten().collect()].concat()
}

/// What is wrong, the bytes, and how the server ends the connection.
pub(crate) fn malformed() -> Vec<(&'static str, Vec<u8>, End)> {
    let after_opening = |frames: &[Vec<u8>]| [opening(), frames.concat()].concat();
    let continued =
        (0..2000).map(|_| frame(CONTINUATION, 0, 1, &[0, 1, b'a', 1, b'b'].repeat(200)));
    let endless = [vec![frame(HEADERS, 0, 1, &POST)], continued.collect()].concat();
    // A length of 2^24 - 1, of which nothing follows.
    let mut giant = frame(DATA, 0, 1, &[]);
    giant[..3].copy_from_slice(&[0xff; 3]);
    let (protocol, size, calm) = (End::GoAway(1), End::GoAway(6), End::GoAway(11));
    vec![
        ("no HTTP", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".repeat(8), End::Closed),
        ("a giant frame", after_opening(&[giant]), size),
        ("settings of five bytes", after_opening(&[frame(SETTINGS, 0, 0, &[0; 5])]), protocol),
        ("data of no call", after_opening(&[frame(DATA, 0, 0, b"x")]), protocol),
        ("a call of the server's", after_opening(&[frame(HEADERS, 4, 2, &POST)]), protocol),
        ("an empty window", after_opening(&[frame(WINDOW_UPDATE, 0, 0, &[0; 4])]), protocol),
        ("broken headers", after_opening(&[frame(HEADERS, 4, 1, &[0xff; 9])]), protocol),
        ("headers without end", after_opening(&endless), calm),
        ("a flood of resets", reset_flood(5000), calm),
    ]
}

/// A connection from another machine, as far as the server can tell.
pub(crate) async fn connect(server: SocketAddr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind((Ipv4Addr::new(127, 0, 0, 2), 0).into())?;
    socket.connect(server).await
}

/// Sends bytes, and waits until the server ends the connection.
pub(crate) async fn send(server: SocketAddr, bytes: &[u8]) -> End {
    let stream = connect(server).await.unwrap();
    let (mut from, mut to) = stream.into_split();
    // The server may end it before everything is sent.
    let sent = async {
        let _ = to.write_all(bytes).await;
        std::future::pending::<()>().await;
    };
    let mut answer = Vec::new();
    let heard = async {
        let mut piece = [0; 4096];
        while let Ok(n @ 1..) = from.read(&mut piece).await {
            answer.extend(&piece[..n]);
        }
    };
    let ended = tokio::select! {
        () = sent => unreachable!("it sends for ever"),
        ended = timeout(Duration::from_secs(20), heard) => ended.is_ok(),
    };
    match (goaway(&answer), ended) {
        (Some(code), _) => End::GoAway(code),
        (None, true) => End::Closed,
        (None, false) => End::Open,
    }
}

/// The error code of the last GOAWAY among frames.
fn goaway(mut answer: &[u8]) -> Option<u32> {
    let mut code = None;
    while let [a, b, c, kind, _, _, _, _, _, rest @ ..] = answer {
        let length = u32::from_be_bytes([0, *a, *b, *c]) as usize;
        let payload = rest.get(..length)?;
        if let (GOAWAY, [_, _, _, _, code_bytes @ ..]) = (*kind, payload) {
            code = code_bytes.first_chunk().map(|bytes| u32::from_be_bytes(*bytes));
        }
        answer = &rest[length..];
    }
    code
}
