//! Webhooks: who is called when a job ends, how often, and who is not.

use std::{
    collections::BTreeMap,
    io::{BufRead, BufReader, Read, Write},
    net::TcpListener,
    sync::mpsc::{Receiver, channel},
    time::Duration,
};

use base64::{Engine, engine::general_purpose::STANDARD};
use lookalike::{service::proto::v1, service::status::faults_of};
use ring::hmac::{HMAC_SHA256, Key, verify};
use serde_json::Value;
use tonic::Code;

use crate::support::{Server, create, create_request, small_torus, upload};

const KEY: &[u8] = b"twenty-four bytes or more";

/// A call as it came.
struct Call {
    path: String,
    headers: BTreeMap<String, String>,
    body: String,
}

impl Call {
    fn id(&self) -> &str {
        &self.headers["webhook-id"]
    }

    /// What the body says, once it is known who wrote it.
    fn verified(&self) -> Value {
        let signed = format!("{}.{}.{}", self.id(), self.headers["webhook-timestamp"], self.body);
        let tag = self.headers["webhook-signature"].strip_prefix("v1,").unwrap();
        let tag = STANDARD.decode(tag).unwrap();
        verify(&Key::new(HMAC_SHA256, KEY), signed.as_bytes(), &tag).unwrap();
        serde_json::from_str(&self.body).unwrap()
    }
}

/// Somebody who is called: what he answers, the last again and again; his address, and what he hears.
fn receiver(answers: &'static [&'static str]) -> (String, Receiver<Call>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let (send, calls) = channel();
    std::thread::spawn(move || {
        for (i, socket) in listener.incoming().enumerate() {
            let mut socket = BufReader::new(socket.unwrap());
            let mut lines = Vec::new();
            loop {
                let mut line = String::new();
                socket.read_line(&mut line).unwrap();
                match line.trim_end() {
                    "" => break,
                    line => lines.push(line.to_owned()),
                }
            }
            let headers = lines[1..].iter().filter_map(|line| line.split_once(": "));
            let headers: BTreeMap<_, _> =
                headers.map(|(k, v)| (k.to_lowercase(), v.to_owned())).collect();
            let mut body = vec![0; headers["content-length"].parse().unwrap()];
            socket.read_exact(&mut body).unwrap();
            let answer = answers[i.min(answers.len() - 1)];
            write!(socket.get_mut(), "HTTP/1.1 {answer}\r\nContent-Length: 0\r\n\r\n").unwrap();
            let path = lines[0].clone();
            let call = Call { path, headers, body: String::from_utf8(body).unwrap() };
            if send.send(call).is_err() {
                return;
            }
        }
    });
    (address, calls)
}

/// A call that a server has taken before it died is its own for a minute.
fn next(calls: &Receiver<Call>) -> Call {
    calls.recv_timeout(Duration::from_secs(150)).expect("nobody calls")
}

fn start(flags: &[&str]) -> Server {
    let secret = format!("whsec_{}", STANDARD.encode(KEY));
    Server::start_in(flags, vec![("LOOKALIKE_WEBHOOK_SECRET".into(), secret)])
}

// Whoever waits for calls must not keep its clients from answering pings.
#[tokio::test(flavor = "multi_thread")]
async fn a_job_s_end_is_told_until_it_is_heard_also_by_the_next_server() {
    let (address, calls) = receiver(&["503 Busy", "200 OK"]);
    let url = format!("--webhook-url={address}/hush?token=t0k3n");
    let mut server = start(&["--workers=0", "--webhook-allow-private", &url]);
    let mut client = server.client();
    let name = create(&mut client).await;
    client.cancel_job(v1::CancelJobRequest { name: name.clone() }).await.unwrap();
    let first = next(&calls);
    server.kill();
    server.restart();
    let second = next(&calls);
    assert_eq!(first.path, "POST /hush?token=t0k3n HTTP/1.1");
    assert_eq!((second.id(), &second.body), (first.id(), &first.body));
    let told = second.verified();
    assert_eq!(
        (&told["type"], &told["data"]["job"]["name"]),
        (&"job.ended".into(), &Value::from(name))
    );
    assert_eq!(told["data"]["job"]["state"], "JOB_STATE_CANCELLED");
    assert_eq!(told["timestamp"], told["data"]["job"]["endTime"]);
    // It was heard.
    let more = calls.recv_timeout(Duration::from_secs(4));
    assert!(more.is_err(), "called again: {}", more.unwrap().body);
    let log = server.logged();
    assert!(log.contains("webhook"), "{log}");
    for secret in [&STANDARD.encode(KEY), "t0k3n", "hush"] {
        assert!(!log.contains(secret), "{secret} is in the log");
    }
}

// Whoever waits for calls must not keep its clients from answering pings.
#[tokio::test(flavor = "multi_thread")]
async fn jobs_name_whom_they_like_among_those_allowed() {
    let (address, calls) = receiver(&["200 OK"]);
    let server = start(&["--workers=1", "--webhook-allow-private", "--webhook-allow=127.0.0.1"]);
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    let request =
        |url: &str| v1::CreateJobRequest { webhook_url: url.into(), ..create_request(&mesh, "") };
    for (url, wanted) in [
        ("https://evil.test/", "evil.test"),
        ("file:///etc/passwd", "https:// or http://"),
        ("http://127.0.0.2/", "127.0.0.2"),
        ("127.0.0.1", "no URL"),
    ] {
        let refused = client.create_job(request(url)).await.unwrap_err();
        let faults = faults_of(&refused);
        assert_eq!(
            (refused.code(), faults[0].field.as_str()),
            (Code::InvalidArgument, "webhook_url")
        );
        assert!(faults[0].text.contains(wanted), "{url}: {}", faults[0].text);
    }
    client.create_job(request(&format!("{address}/done"))).await.unwrap();
    let told = next(&calls).verified();
    assert_eq!(told["data"]["job"]["state"], "JOB_STATE_SUCCEEDED");
    // Whoever names nobody has nobody called.
    create(&mut client).await;
    assert!(calls.recv_timeout(Duration::from_secs(4)).is_err());
    let closed = Server::start_with(&["--workers=0"]);
    let mut client = closed.client();
    upload(&mut client, small_torus()).await;
    let refused = client.create_job(request(&address)).await.unwrap_err();
    assert!(faults_of(&refused)[0].text.contains("--webhook-secret"));
}
