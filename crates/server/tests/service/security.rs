//! Tokens, certificates, rights by verb and room, and the bounds on connections.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use seese3_client::proto::v1 as pb;
use seese3_client::{Client, ClientTls, ConnectOptions};
use seese3_server::{Config, Keyring, Tls, TlsFiles};
use sha2::{Digest, Sha256};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

use crate::harness::{
    PATIENCE, StoppedClock, TestServer, code_of, filled_store, frame, question, soon, start,
    start_on, to_frame, until,
};
use crate::http2::opened;
use crate::isolation;

const VERBS: [&str; 7] = [
    "navigate", "localize", "track", "evaluate", "catalog", "write", "download",
];

fn hex_digest(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// One principal of a file of credentials, whose token is its name.
pub fn principal(name: &str, verbs: &str, rooms: &str) -> String {
    format!(
        "[[principal]]\nname = \"{name}\"\ntoken_sha256 = \"{}\"\nverbs = [{verbs}]\nrooms = [{rooms}]\nstreams = 1\n",
        hex_digest(name.as_bytes())
    )
}

/// A principal for every verb with all rooms, one with all verbs and one room, and one with all.
fn credentials() -> String {
    let all = VERBS.map(|verb| format!("\"{verb}\"")).join(", ");
    let mut file: String = VERBS
        .map(|verb| principal(verb, &format!("\"{verb}\""), "\"*\""))
        .concat();
    file += &principal("one-room", &all, "\"synthetic\"");
    file += &principal("everything", &all, "\"*\"");
    file
}

async fn start_with_credentials() -> TestServer {
    let (folder, store) = filled_store().await;
    let file = folder.path().join("auth.toml");
    std::fs::write(&file, credentials()).unwrap();
    let config = Config {
        keyring: Some(Arc::new(Keyring::open(file).unwrap())),
        writable: true,
        ..Config::default()
    };

    start_on(folder, store, config).await
}

pub async fn client_with(server: &TestServer, token: Option<&str>) -> Client {
    let options = ConnectOptions {
        deadline: PATIENCE,
        token: token.map(str::to_owned),
        tls: None,
    };
    Client::connect_with(&server.address, options)
        .await
        .unwrap()
}

/// Asks one RPC of each verb, in their order.
async fn asked(client: &Client) -> [Code; 7] {
    asked_in(client, "synthetic").await
}

/// Asks one RPC of each verb about a room.
async fn asked_in(client: &Client, room: &str) -> [Code; 7] {
    let localized = client.localize(pb::LocalizeRequest {
        rooms: vec![room.to_owned()],
        view: frame(3),
        ..pb::LocalizeRequest::default()
    });
    let estimated = client.estimate_motion(pb::EstimateMotionRequest {
        room: room.to_owned(),
        first: frame(3),
        second: frame(5),
        ..pb::EstimateMotionRequest::default()
    });
    let evaluated = client.evaluate(
        pb::EvaluateRequest {
            room: room.to_owned(),
            stride: Some(40),
            ..pb::EvaluateRequest::default()
        },
        |_| (),
    );

    let navigated = pb::NavigateRequest {
        room: room.to_owned(),
        source: frame(3),
        motion: to_frame(5),
        ..pb::NavigateRequest::default()
    };
    let nothing_chosen = client.clear_default(pb::ClearDefaultRequest {
        default: Some(pb::clear_default_request::Default::RevisionOfRoom(
            room.to_owned(),
        )),
        ..pb::ClearDefaultRequest::default()
    });

    let downloaded = pb::DownloadRoomRequest {
        room: room.to_owned(),
        ..pb::DownloadRoomRequest::default()
    };
    let received = |_| Ok::<_, seese3_client::Error>(());

    [
        code_of(client.navigate(navigated).await),
        code_of(localized.await),
        code_of(estimated.await),
        code_of(evaluated.await),
        code_of(client.room(room).await),
        code_of(nothing_chosen.await),
        code_of(client.download_room(downloaded, received).await),
    ]
}

/// Oracle: the meaning of the file: a caller may what its verbs say and nothing else; nobody may
/// anything without a token that is known; health needs none.
#[tokio::test]
async fn a_caller_may_what_its_verbs_say_and_nothing_else() {
    let server = start_with_credentials().await;

    for (granted, verb) in VERBS.iter().enumerate() {
        let codes = asked(&client_with(&server, Some(verb)).await).await;
        for (needed, code) in codes.into_iter().enumerate() {
            let expected = if needed == granted {
                Code::Ok
            } else {
                Code::PermissionDenied
            };
            assert_eq!(code, expected, "{verb} asks what needs {}", VERBS[needed]);
        }
    }

    let everything = client_with(&server, Some("everything")).await;
    assert_eq!(asked(&everything).await, [Code::Ok; 7]);

    for token in [None, Some("nobody"), Some("Everything")] {
        let client = client_with(&server, token).await;
        assert_eq!(
            asked(&client).await,
            [Code::Unauthenticated; 7],
            "{token:?}"
        );
        assert!(client.serves("").await.unwrap(), "health needs no token");
    }
}

/// Oracle: the meaning of the file, for every verb with every kind of scope, and every room: what
/// is not in both does not exist or is forbidden. Each caller has one verb.
#[tokio::test]
async fn every_verb_is_held_to_every_scope() {
    let scopes = [
        ("all", "\"*\"", [true, true]),
        ("one", "\"synthetic\"", [true, false]),
        ("other", "\"synthetic_b\"", [false, true]),
        ("beginning", "\"synthetic_*\"", [false, true]),
        ("none", "\"elsewhere\"", [false, false]),
    ];
    let mut file = String::new();
    for verb in VERBS {
        for (name, rooms, _) in scopes {
            file += &principal(&format!("{verb}-{name}"), &format!("\"{verb}\""), rooms);
        }
    }
    let (folder, store) = filled_store().await;
    let auth = folder.path().join("auth.toml");
    std::fs::write(&auth, file).unwrap();
    let config = Config {
        keyring: Some(Arc::new(Keyring::open(auth).unwrap())),
        writable: true,
        ..Config::default()
    };
    let server = start_on(folder, store, config).await;

    for (granted, verb) in VERBS.iter().enumerate() {
        for (name, _, seen) in scopes {
            let client = client_with(&server, Some(&format!("{verb}-{name}"))).await;
            for (room, is_seen) in ["synthetic", "synthetic_b"].into_iter().zip(seen) {
                let codes = asked_in(&client, room).await;
                for (needed, code) in codes.into_iter().enumerate() {
                    let expected = match (needed == granted, is_seen, VERBS[needed]) {
                        // Whether there is such a room is not told to who may not change it.
                        (false, ..) | (true, false, "write") => Code::PermissionDenied,
                        (true, false, _) => Code::NotFound,
                        (true, true, _) => Code::Ok,
                    };
                    let asks = VERBS[needed];
                    assert_eq!(code, expected, "{verb}-{name} asks {asks} of {room}");
                }
            }
        }
    }
}

/// Oracle: PyJWT, which signed the tokens, and the meaning of `scope`.
#[cfg(feature = "jwt")]
#[tokio::test]
async fn tokens_that_an_issuer_signed_are_taken() {
    let (folder, store) = filled_store().await;
    let jwt = seese3_testing::golden().join("jwt");
    let file = folder.path().join("auth.toml");
    let all = VERBS.map(|verb| format!("\"{verb}\"")).join(", ");
    std::fs::copy(jwt.join("p256.pem"), folder.path().join("login.pem")).unwrap();
    let issuer = format!(
        "[[issuer]]\nissuer = \"https://login.example.org\"\naudience = \"seese3\"\n\
         public_keys = [\"login.pem\"]\nverbs = [{all}]\nrooms = [\"*\"]\n"
    );
    std::fs::write(&file, issuer).unwrap();
    let config = Config {
        keyring: Some(Arc::new(Keyring::open(file).unwrap())),
        writable: true,
        ..Config::default()
    };
    let server = start_on(folder, store, config).await;

    let tokens = std::fs::read(jwt.join("tokens.json")).unwrap();
    let tokens: serde_json::Value = serde_json::from_slice(&tokens).unwrap();
    let codes =
        async |token: &serde_json::Value| asked(&client_with(&server, token.as_str()).await).await;

    assert_eq!(codes(&tokens["good"]["ES256"]).await, [Code::Ok; 7]);
    let denied = Code::PermissionDenied;
    let scoped = codes(&tokens["narrowed"]["scope"]).await;
    let expected = [Code::Ok, denied, denied, denied, denied, Code::Ok, denied];
    assert_eq!(scoped, expected);
    for what in ["expired", "of another key", "of no algorithm"] {
        let codes = codes(&tokens["bad"][what][0]).await;
        assert_eq!(codes, [Code::Unauthenticated; 7], "{what}");
    }
}

/// Oracle: the promise: a room that a caller may not see is answered exactly as one that does not
/// exist.
#[tokio::test]
async fn a_room_out_of_reach_does_not_exist() {
    let server = start_with_credentials().await;
    let client = client_with(&server, Some("one-room")).await;
    assert_eq!(asked(&client).await, [Code::Ok; 7]);

    let names: Vec<String> = client
        .rooms()
        .await
        .unwrap()
        .into_iter()
        .map(|room| room.name)
        .collect();
    assert_eq!(names, ["synthetic"]);

    let navigate = async |room: &str| {
        let request = pb::NavigateRequest {
            room: room.to_owned(),
            source: frame(10),
            motion: to_frame(20),
            ..pb::NavigateRequest::default()
        };
        client.navigate(request).await.unwrap_err().to_string()
    };
    let hidden = navigate("synthetic_b").await;
    let unknown = navigate("synthetic_c").await;
    assert_eq!(hidden.replace("synthetic_b", "synthetic_c"), unknown);

    // All rooms are searched, of those that may be seen.
    let localized = client
        .localize(pb::LocalizeRequest {
            adapter: "oracle".to_owned(),
            view: crate::harness::feature(crate::harness::feature_row(3)),
            ..pb::LocalizeRequest::default()
        })
        .await
        .unwrap();
    assert_eq!(localized.room_count, 1);
}

/// An authority, and certificates that it issued.
struct Authority {
    issuer: CertifiedIssuer<'static, KeyPair>,
}

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        Self {
            issuer: CertifiedIssuer::self_signed(params, key).unwrap(),
        }
    }

    fn pem(&self) -> Vec<u8> {
        self.issuer.pem().into_bytes()
    }

    /// A certificate and its key, in PEM, and the certificate's fingerprint.
    fn issue(&self, name: &str) -> (Vec<u8>, Vec<u8>, String) {
        let params = CertificateParams::new(vec![name.to_owned()]).unwrap();
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();

        (
            certificate.pem().into_bytes(),
            key.serialize_pem().into_bytes(),
            hex_digest(certificate.der()),
        )
    }

    /// Files of a server's certificate.
    fn server_files(&self, folder: &Path, asks_clients: bool) -> TlsFiles {
        let (cert, key, _) = self.issue("127.0.0.1");
        let write = |name: &str, content: &[u8]| -> PathBuf {
            let file = folder.join(name);
            std::fs::write(&file, content).unwrap();
            file
        };

        TlsFiles {
            cert: write("server.pem", &cert),
            key: write("server.key", &key),
            client_ca: asks_clients.then(|| write("ca.pem", &self.pem())),
        }
    }
}

async fn tls_client(
    address: &str,
    authority: &Authority,
    identity: Option<(Vec<u8>, Vec<u8>)>,
) -> Result<Client, seese3_client::Error> {
    let options = ConnectOptions {
        deadline: PATIENCE,
        token: None,
        tls: Some(ClientTls {
            authorities: authority.pem(),
            identity,
        }),
    };
    Client::connect_with(address, options).await
}

/// A server with TLS, which the harness's own client, in plain text, cannot wait for.
async fn start_tls(config: Config) -> (String, tempfile::TempDir) {
    let (folder, store) = filled_store().await;
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(seese3_server::run(
        listener,
        store,
        config,
        std::future::pending(),
    ));
    (address, folder)
}

async fn until_served(client: &Client) {
    let serves = async || client.serves("").await.unwrap_or(false);
    until("the server serves", serves, |serves| *serves).await;
}

/// Oracle: what TLS promises: a client that trusts the authority is answered, and neither plain
/// text nor another authority is; a replaced certificate is used without a restart.
#[tokio::test]
async fn tls_answers_who_trusts_it_and_takes_a_new_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let files = authority.server_files(folder.path(), false);
    let config = Config {
        tls: Some(Arc::new(Tls::open(files).unwrap())),
        ..Config::default()
    };
    let (address, _store) = start_tls(config).await;

    let client = tls_client(&address, &authority, None).await.unwrap();
    until_served(&client).await;
    assert!(client.navigate(question()).await.is_ok());

    let plain = Client::connect(&address, PATIENCE).await;
    assert!(match plain {
        Ok(client) => client.navigate(question()).await.is_err(),
        Err(_) => true,
    });
    let other = Authority::new();
    assert!(tls_client(&address, &other, None).await.is_err());

    // The other authority's certificate takes the place of the first; old connections stay.
    other.server_files(folder.path(), false);
    let replaced = async || tls_client(&address, &other, None).await.is_ok();
    until("the certificate is replaced", replaced, |replaced| {
        *replaced
    })
    .await;
    assert!(client.navigate(question()).await.is_ok());
}

/// Oracle: what mutual TLS promises, and the meaning of `certificate_sha256`.
#[tokio::test]
async fn a_certificate_is_needed_and_says_who_is_calling() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (robot_cert, robot_key, fingerprint) = authority.issue("robot");
    let (guest_cert, guest_key, _) = authority.issue("guest");

    let auth = folder.path().join("auth.toml");
    let known = format!(
        "[[principal]]\nname = \"robot\"\ncertificate_sha256 = \"{fingerprint}\"\nverbs = [\"navigate\"]\nrooms = [\"*\"]\n"
    );
    std::fs::write(&auth, known).unwrap();
    let files = authority.server_files(folder.path(), true);
    let config = Config {
        tls: Some(Arc::new(Tls::open(files).unwrap())),
        keyring: Some(Arc::new(Keyring::open(auth).unwrap())),
        ..Config::default()
    };
    let (address, _store) = start_tls(config).await;

    let robot = tls_client(&address, &authority, Some((robot_cert, robot_key))).await;
    let robot = robot.unwrap();
    until_served(&robot).await;
    assert_eq!(code_of(robot.navigate(question()).await), Code::Ok);
    assert_eq!(code_of(robot.rooms().await), Code::PermissionDenied);

    let guest = tls_client(&address, &authority, Some((guest_cert, guest_key))).await;
    let guest = guest.unwrap().navigate(question()).await;
    assert_eq!(code_of(guest), Code::Unauthenticated);

    // Without any certificate the connection ends, at the handshake or at its first use.
    let nobody = tls_client(&address, &authority, None).await;
    assert!(match nobody {
        Ok(client) => client.navigate(question()).await.is_err(),
        Err(_) => true,
    });
}

/// Oracle: the contract: who has no credential cannot keep others out by holding connections,
/// neither silent ones nor open ones, and does not end those of others.
#[tokio::test]
async fn connections_without_credentials_make_room() {
    let config = Config {
        connections: 4,
        ..Config::default()
    };
    let robots = ["first", "second", "third"];
    let robots = robots.map(|name| principal(name, "\"navigate\", \"track\"", "\"*\""));
    let server = isolation::server(config, &robots.concat()).await;
    let question = || pb::NavigateRequest {
        room: "lab".to_owned(),
        source: frame(3),
        motion: to_frame(5),
        ..pb::NavigateRequest::default()
    };

    let first = client_with(&server, Some("first")).await;
    assert!(first.navigate(question()).await.is_ok());
    let (requests, open) = tokio::sync::mpsc::channel(1);
    let tracked = client_with(&server, Some("second")).await;
    let config = pb::TrackConfig {
        room: "lab".to_owned(),
        ..pb::TrackConfig::default()
    };
    let message = Some(pb::track_request::Message::Config(config));
    requests.send(pb::TrackRequest { message }).await.unwrap();
    let mut stream = tracked.track(ReceiverStream::new(open)).await.unwrap();
    stream.message().await.unwrap().unwrap();

    let mut held = Vec::new();
    for number in 0..20 {
        held.push(if number % 2 == 0 {
            TcpStream::connect(&server.address).await.unwrap()
        } else {
            opened(&server.address, &[]).await
        });
    }
    let other = client_with(&server, Some("third")).await;
    assert!(other.navigate(question()).await.is_ok());

    let mut ended = 0;
    for connection in &mut held {
        let mut heard = Vec::new();
        let read = tokio::time::timeout(
            Duration::from_millis(50),
            connection.read_to_end(&mut heard),
        );
        ended += usize::from(read.await.is_ok());
    }
    assert!(
        ended >= 18,
        "{ended} of 20 were closed for the places of two, and then of one"
    );

    let still_open = tokio::time::timeout(Duration::from_millis(50), stream.message());
    assert!(still_open.await.is_err(), "the stream goes on");
}

/// Oracle: the contract: after a burst of connections at the limit, a newcomer takes the place of
/// one of them at once, and not when its time limit of 10 s ends.
#[tokio::test(flavor = "multi_thread")]
async fn a_burst_of_connections_keeps_nobody_out() {
    let config = Config {
        connections: 64,
        ..Config::default()
    };
    let robot = principal("robot", "\"catalog\"", "\"*\"");
    let server = isolation::server(config, &robot).await;
    for _ in 0..20 {
        let mut burst = tokio::task::JoinSet::new();
        for _ in 0..104 {
            let address = server.address.clone();
            burst.spawn(async move { TcpStream::connect(address).await.unwrap() });
        }
        let _held = burst.join_all().await;

        let newcomer = client_with(&server, Some("robot"));
        let newcomer = tokio::time::timeout(Duration::from_secs(3), newcomer).await;
        let answer = newcomer.expect("it is admitted").rooms().await;
        assert!(answer.is_ok(), "{answer:?}");
    }
}

/// Oracle: the contract: a caller that holds all connections yields to another, and a
/// refused call holds none.
#[tokio::test]
async fn callers_divide_the_connections() {
    let config = Config {
        connections: 8,
        ..Config::default()
    };
    let callers = ["greedy", "robot"].map(|name| principal(name, "\"catalog\"", "\"*\""));
    let guest = principal("guest", "\"track\"", "\"*\"");
    let server = isolation::server(config, &(callers.concat() + &guest)).await;
    let call = async |client: &Client| {
        let answer = client.rooms().await;
        answer
            .map(drop)
            .map_err(|error| error.code().unwrap_or(Code::Unknown))
    };

    // Connections beyond the limit close the oldest.
    let mut guests = Vec::new();
    for _ in 0..16 {
        let guest = client_with(&server, Some("guest")).await;
        assert_eq!(call(&guest).await, Err(Code::PermissionDenied));
        guests.push(guest);
    }

    let mut greedy = Vec::new();
    for _ in 0..7 {
        let client = client_with(&server, Some("greedy")).await;
        assert_eq!(call(&client).await, Ok(()));
        greedy.push(client);
    }
    let one_more = client_with(&server, Some("greedy")).await;
    assert_eq!(call(&one_more).await, Err(Code::ResourceExhausted));

    let robot = client_with(&server, Some("robot")).await;
    assert_eq!(call(&robot).await, Ok(()));
    assert_eq!(
        call(&greedy[0]).await,
        Ok(()),
        "established connections stay"
    );
}

/// Oracle: the bounds themselves: connections beyond the limit are closed at once, and those that
/// say nothing do not hold up the end of the server.
#[tokio::test]
async fn silent_connections_are_bounded_and_hold_nobody_up() {
    // No time passes after which silent connections are closed, or after which a server that
    // stops gives up.
    let clock = StoppedClock::new();
    let lame_duck = Duration::from_secs(1);
    let config = Config {
        connections: 3,
        lame_duck,
        ..Config::default()
    };
    let server = start(config).await;

    // One place is the client's.
    let silent = [
        TcpStream::connect(&server.address).await.unwrap(),
        TcpStream::connect(&server.address).await.unwrap(),
    ];
    let mut refused = TcpStream::connect(&server.address).await.unwrap();
    let ended = soon("it is closed", refused.read(&mut [0; 1])).await;
    assert!(!matches!(ended, Ok(1..)), "it is closed and hears nothing");
    assert!(server.client.navigate(question()).await.is_ok());

    drop(silent);
    let connects = async || Client::connect(&server.address, PATIENCE).await.is_ok();
    until("the places are free again", connects, |connects| *connects).await;

    let _silent = TcpStream::connect(&server.address).await.unwrap();
    server.stop.send(()).unwrap();
    let serves = async || server.client.serves("").await.unwrap();
    until("health says so", serves, |serves| !*serves).await;
    clock.advance(lame_duck).await;
    let ended = soon("the server ends", server.ended).await;
    ended.unwrap().unwrap();
}
