//! The agent over TLS: the token goes to no server whose certificate is not right.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::thread;

use coflash_agent::{Config, Ended};
use kit::hawkbit::{Action, Fault, File, Server};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, ServerConnection, StreamOwned};

fn pem(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tls").join(name)
}

/// TLS with this certificate in front of a server; returns its URL.
fn before(server: &Server, certificate: &str) -> String {
    let chain = vec![CertificateDer::from_pem_file(pem(certificate)).unwrap()];
    let key = PrivateKeyDer::from_pem_file(pem("server.key")).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
    let config = Arc::new(config.with_no_client_auth().with_single_cert(chain, key).unwrap());
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    let behind = server.url.trim_start_matches("http://").to_string();
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let (config, behind) = (config.clone(), behind.clone());
            thread::spawn(move || {
                // A client that does not trust us goes away in the middle.
                let _ = pass(stream, config, &behind);
            });
        }
    });
    server.state().url.clone_from(&url);
    url
}

/// Passes one request on, and its answer back.
fn pass(stream: TcpStream, config: Arc<ServerConfig>, behind: &str) -> std::io::Result<()> {
    let connection = ServerConnection::new(config).map_err(std::io::Error::other)?;
    let mut outside = StreamOwned::new(connection, stream);
    let mut inside = TcpStream::connect(behind)?;
    let mut request = Vec::new();
    let mut buffer = [0; 4096];
    loop {
        let count = outside.read(&mut buffer)?;
        if count == 0 {
            return Ok(());
        }
        request.extend_from_slice(&buffer[..count]);
        let text = String::from_utf8_lossy(&request);
        let Some((head, body)) = text.split_once("\r\n\r\n") else { continue };
        let length =
            head.lines().find_map(|line| line.to_lowercase().strip_prefix("content-length: ")?.parse().ok());
        if body.len() >= length.unwrap_or(0) {
            break;
        }
    }
    inside.write_all(&request)?;
    let mut answer = Vec::new();
    inside.read_to_end(&mut answer)?;
    outside.write_all(&answer)?;
    outside.conn.send_close_notify();
    outside.flush()
}

/// Runs the agent with these certificates to trust.
fn once(url: &str, ca_file: Option<&str>, test: &str) -> (Ended, String) {
    let folder = crate::folder(test);
    folder.file("token", b"t-door");
    let ca_file = ca_file.map(|name| format!("ca-file = '{}'\n", pem(name).display())).unwrap_or_default();
    let text = format!(
        "url = '{url}'\n{ca_file}[[device]]\ncontroller-id = 'door'\nbus = 'socketcan:can0'\nnode = 5\n\
         token-file = 'token'\n"
    );
    let config = Config::parse(&text, &folder, None, None).unwrap();
    crate::run_once(&config, &crate::Fake::default())
}

#[test]
fn a_server_is_trusted_with_the_certificates_that_are_named() {
    let server = Server::start(&["door"]);
    let url = before(&server, "server.pem");
    server.assign("door", Action::new(1, &File::new("a.blk", data!("identity-110.blk"))));
    let (ended, said) = once(&url, Some("authority.pem"), "good");
    assert_eq!((ended.updated, ended.unserved), (1, 0), "{said}");
    assert_eq!(server.action("door").result.as_deref(), Some("success"));
}

#[test]
fn a_server_with_another_certificate_gets_no_request() {
    for (ca_file, test) in [(None, "usual"), (Some("other.pem"), "other")] {
        let server = Server::start(&["door"]);
        let url = before(&server, "server.pem");
        let (ended, said) = once(&url, ca_file, test);
        assert_eq!((ended.updated, ended.unserved), (0, 1), "{said}");
        assert!(said.contains("certificate"), "{said}");
        assert!(server.seen("/").is_empty());
        // Nor does a server whose name is another: the certificate is for 127.0.0.1.
        let (ended, said) = once(&url.replace("127.0.0.1", "localhost"), Some("authority.pem"), test);
        assert_eq!(ended.unserved, 1, "{said}");
        assert!(server.seen("/").is_empty(), "{said}");
    }
}

/// RFC 5280 section 4.2.1.9, as the library reads it: the certificate of an authority is not one of
/// a server.
#[test]
fn a_server_that_is_its_own_authority_gets_advice_and_no_request() {
    let server = Server::start(&["door"]);
    let (ended, said) = once(&before(&server, "own.pem"), Some("own.pem"), "own");
    assert_eq!(ended.unserved, 1, "{said}");
    assert!(said.contains("CA:TRUE") && said.contains("basicConstraints=critical,CA:FALSE"), "{said}");
    assert!(server.seen("/").is_empty());
}

/// A file over http would be checked like any other; but who asks for it would be seen, and the
/// server promised https.
#[test]
fn a_redirect_from_https_to_http_is_not_followed() {
    let (server, plain) = (Server::start(&["door"]), Server::start(&["cdn"]));
    let url = before(&server, "server.pem");
    let action = Action::new(1, &File::new("a.blk", data!("identity-110.blk")));
    plain.assign("cdn", action.clone());
    server.assign("door", action);
    server.fault("artifacts", 100, Fault::Redirect(format!("{}/files/a.blk", plain.url)));
    let (ended, said) = once(&url, Some("authority.pem"), "downgrade");
    assert_eq!((ended.updated, ended.failed), (0, 1), "{said}");
    assert!(said.contains("redirects from https to http"), "{said}");
    assert!(plain.seen("/").is_empty());
    // Within https it may lead anywhere, in any form.
    let host = url.strip_prefix("https:").unwrap();
    for (number, to) in ["a.blk?2".to_string(), format!("{host}/files/a.blk")].into_iter().enumerate() {
        server.state().faults.clear();
        server.assign("door", Action::new(2 + number as u64, &File::new("a.blk", data!("identity-110.blk"))));
        server.fault("artifacts", 1, Fault::Redirect(to.clone()));
        let (ended, said) = once(&url, Some("authority.pem"), "downgrade");
        assert_eq!(ended.updated, 1, "{to}: {said}");
    }
}
