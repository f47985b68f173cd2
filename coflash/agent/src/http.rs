//! Requests to the server, each with limits of time and size.
//!
//! The token goes to the server itself and nowhere else: redirects are followed here, not by the
//! library.

use std::io::Read;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use ureq::http::{HeaderMap, Response};
use ureq::typestate::WithBody;
use ureq::{Agent, Body, Proxy, RequestBuilder};

use super::config::Token;
use super::controller::{Reply, Request};
use super::url::{redirected, Server};

/// The largest answer that is read, apart from files.
const ANSWER_MOST: u64 = 256 * 1024;
/// The most redirects that are followed.
const REDIRECTS_MOST: usize = 3;

/// The limits of time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// For a connection, and for each read.
    pub(super) silent: Duration,
    /// For a whole request, apart from files.
    pub(super) request: Duration,
}

/// The connection to the server.
#[derive(Debug)]
pub(super) struct Client {
    agent: Agent,
    server: Server,
}

/// The beginning of a file, or of a part of it.
pub(super) struct Opened {
    pub(super) status: u16,
    pub(super) headers: HeaderMap,
    pub(super) body: Body,
}

impl Client {
    /// A connection through this proxy, or without one: those of the environment are for what the
    /// user of the computer looks at, and would see the token.
    ///
    /// # Errors
    /// In words, for a proxy or a file with certificates that cannot be used.
    pub(super) fn new(
        server: Server,
        proxy: Option<&str>,
        ca_file: Option<&Path>,
        limits: Limits,
    ) -> Result<Self, String> {
        let proxy = proxy.filter(|_| !server.is_local()).map(Proxy::new).transpose();
        let proxy = proxy.map_err(|error| format!("the proxy cannot be used: {error}"))?;
        let config = Agent::config_builder()
            .proxy(proxy)
            .user_agent(concat!("coflash/", env!("CARGO_PKG_VERSION")))
            .http_status_as_error(false)
            .max_redirects(0)
            .max_redirects_will_error(false)
            .timeout_connect(Some(limits.silent))
            .timeout_recv_response(Some(limits.request))
            .timeout_per_read(Some(limits.silent))
            .timeout_send_body(Some(limits.request));
        #[cfg(feature = "tls")]
        let config = match ca_file {
            Some(path) => config.tls_config(trusting(path)?),
            None => config,
        };
        #[cfg(not(feature = "tls"))]
        if let Some(path) = ca_file {
            return Err(format!("{}: this coflash was built without the feature tls", path.display()));
        }
        Ok(Self { agent: config.build().new_agent(), server })
    }

    /// Carries out a request below the root resource `root`.
    pub(super) fn send(
        &self,
        root: &str,
        token: &Token,
        request: &Request,
        limits: Limits,
    ) -> Result<Reply, String> {
        let message = |request: RequestBuilder<WithBody>, body: &Value| {
            let request = request.header("Authorization", token.header());
            let request = request.header("Content-Type", "application/json");
            let limited = request.config().timeout_global(Some(limits.request)).build();
            limited.send(body.to_string()).map(opened).map_err(words)
        };
        let mut opened = match request {
            Request::Get(link) => {
                let link = if link.is_empty() { root } else { link };
                self.get(link, token, None, true, Some(limits.request))?
            }
            Request::Post(path, body) => message(self.agent.post(format!("{root}/{path}")), body)?,
            Request::Put(path, body) => message(self.agent.put(format!("{root}/{path}")), body)?,
        };
        if (300..400).contains(&opened.status) {
            return Err("the server redirects a message, which is not followed: check the url".to_string());
        }
        let retry_after = opened.retry_after();
        let body = match opened.status {
            200 => {
                let mut body = Vec::new();
                let reader = opened.body.as_reader();
                reader.take(ANSWER_MOST + 1).read_to_end(&mut body).map_err(|error| error.to_string())?;
                if body.len() as u64 > ANSWER_MOST {
                    return Err(format!("the server's answer has more than {ANSWER_MOST} bytes"));
                }
                body
            }
            _ => Vec::new(),
        };
        Ok(Reply { status: opened.status, retry_after, body })
    }

    /// Begins to fetch a file, from this byte on.
    pub(super) fn open(&self, link: &str, token: &Token, from: u64) -> Result<Opened, String> {
        let range = (from > 0).then(|| format!("bytes={from}-"));
        self.get(link, token, range.as_deref(), false, None)
    }

    /// A GET that follows redirects. `own` permits no other server; another one never gets the
    /// token.
    fn get(
        &self,
        link: &str,
        token: &Token,
        range: Option<&str>,
        own: bool,
        limit: Option<Duration>,
    ) -> Result<Opened, String> {
        const NONE: &str = "the server gives a link that is none";
        let (mut url, mut is_own) = self.server.resolve(link).ok_or(NONE)?;
        for _ in 0..=REDIRECTS_MOST {
            if own && !is_own {
                let advice =
                    "set url to the address under which the server knows itself, or let its proxy pass \
                              X-Forwarded headers on";
                return Err(format!("the server's link leads elsewhere ({}): {advice}", shown(&url)));
            }
            let mut request = self.agent.get(&url).header("Accept", "*/*");
            if own {
                request = self.agent.get(&url).header("Accept", "application/hal+json, application/json");
            }
            if is_own {
                request = request.header("Authorization", token.header());
            }
            if let Some(range) = range {
                request = request.header("Range", range);
            }
            let request = request.config().timeout_global(limit).build();
            let opened = opened(request.call().map_err(words)?);
            if !matches!(opened.status, 301 | 302 | 303 | 307 | 308) {
                return Ok(opened);
            }
            let location = opened.header("location").ok_or("the server redirects to nowhere")?;
            (url, is_own) = self.server.resolve(&redirected(&url, location)?).ok_or(NONE)?;
        }
        Err(format!("the server redirects more than {REDIRECTS_MOST} times"))
    }
}

impl Opened {
    pub(super) fn header(&self, name: &str) -> Option<&str> {
        self.headers.get(name)?.to_str().ok()
    }

    /// The seconds in `Retry-After`. The form with a date counts as none.
    pub(super) fn retry_after(&self) -> Option<Duration> {
        self.header("retry-after")?.trim().parse().ok().map(Duration::from_secs)
    }
}

fn opened(response: Response<Body>) -> Opened {
    let (parts, body) = response.into_parts();
    Opened { status: parts.status.as_u16(), headers: parts.headers, body }
}

/// A URL without its query, which may be a secret of its own.
fn shown(url: &str) -> &str {
    url.split('?').next().unwrap_or(url)
}

/// The library's error in words. It holds no header.
fn words(error: ureq::Error) -> String {
    match error {
        ureq::Error::Timeout(_) => "the server does not answer in time".to_string(),
        ureq::Error::HostNotFound => {
            "the server's name is unknown: check the url and the network".to_string()
        }
        ureq::Error::ConnectionFailed => "there is no connection to the server".to_string(),
        error => {
            let words = error.to_string();
            // By the name that the library has for it.
            let advice = if words.contains("CaUsedAsEndEntity") { OWN_AUTHORITY } else { "" };
            format!("the server cannot be reached: {words}{advice}")
        }
    }
}

/// What to do about a certificate that is its own authority.
const OWN_AUTHORITY: &str = ": the server's certificate is one of an authority (CA:TRUE), as openssl req -x509 makes \
    it, which no server may have: make it anew with -addext basicConstraints=critical,CA:FALSE and name it in ca-file";

/// Trust in the certificates of a PEM file alone.
#[cfg(feature = "tls")]
fn trusting(path: &Path) -> Result<ureq::tls::TlsConfig, String> {
    use ureq::tls::{parse_pem, PemItem, RootCerts, TlsConfig};

    let text =
        coflash_core::file::limit::read_text(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let mut certificates = Vec::new();
    for item in parse_pem(text.as_bytes()) {
        match item {
            Ok(PemItem::Certificate(certificate)) => certificates.push(certificate),
            Ok(_) => {}
            Err(error) => return Err(format!("{}: {error}", path.display())),
        }
    }
    if certificates.is_empty() {
        return Err(format!("{}: it holds no certificate in PEM form", path.display()));
    }
    Ok(TlsConfig::builder().root_certs(RootCerts::new_with_certs(&certificates)).build())
}
