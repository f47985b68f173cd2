//! Who may ask: a page of this server, opened by the one who started it.
//!
//! The token stands in the path of the URL and not in a cookie: cookies do not tell ports apart, so
//! that another server on this machine would be sent it.

use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::{header, HeaderMap, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::firmware::FILE_MAX;

/// How long a request with a body may take to arrive and to be answered.
const WITHIN: Duration = Duration::from_secs(60);

/// What a request has to show.
#[derive(Clone, Debug)]
pub(super) struct Guard {
    pub(super) token: String,
    pub(super) port: u16,
}

impl Guard {
    /// A token that nobody guesses: 128 bits of the system's randomness.
    pub(super) fn token() -> Result<String, getrandom::Error> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes)?;
        Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Why a request is turned away, if it is.
    fn objection(
        &self,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Option<(StatusCode, &'static str)> {
        let hosts = [format!("127.0.0.1:{}", self.port), format!("localhost:{}", self.port)];
        let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or_default());
        // A name that somebody has pointed at 127.0.0.1 is not ours.
        let host = text(header::HOST).or(uri.authority().map(|authority| authority.as_str()));
        if !host.is_some_and(|host| hosts.iter().any(|own| own == host)) {
            return Some((StatusCode::FORBIDDEN, "this server is 127.0.0.1 alone"));
        }
        let own_origin = |origin: &str| {
            origin.strip_prefix("http://").is_some_and(|origin| hosts.iter().any(|own| own == origin))
        };
        if text(header::ORIGIN).is_some_and(|origin| !own_origin(origin)) {
            return Some((StatusCode::FORBIDDEN, "a page of another origin may not ask"));
        }
        // Browsers say who asks: this page, or (none) the person.
        let site = headers.get("sec-fetch-site").map(|value| value.as_bytes());
        if site.is_some_and(|site| !matches!(site, b"same-origin" | b"none")) {
            return Some((StatusCode::FORBIDDEN, "a page of another origin may not ask"));
        }
        let shown = uri.path().strip_prefix('/').and_then(|path| path.split('/').next()).unwrap_or_default();
        if !same(shown.as_bytes(), self.token.as_bytes()) {
            return Some((
                StatusCode::FORBIDDEN,
                "the token is missing or wrong: open the URL that coflash ui printed",
            ));
        }
        // A body that says how long it is need not be heard first.
        let long = text(header::CONTENT_LENGTH).and_then(|len| len.parse::<u64>().ok());
        if long.is_some_and(|len| len > FILE_MAX as u64) {
            return Some((StatusCode::PAYLOAD_TOO_LARGE, "this is more than any program has"));
        }
        if !matches!(*method, Method::GET | Method::POST) {
            return Some((StatusCode::METHOD_NOT_ALLOWED, "GET and POST alone are answered"));
        }
        None
    }
}

/// Compares without telling by its time where they differ.
fn same(one: &[u8], other: &[u8]) -> bool {
    one.len() == other.len() && one.iter().zip(other).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

/// In front of everything: turns away who may not ask, and gives each answer the headers that keep
/// the page to itself.
pub(super) async fn guard(State(guard): State<Guard>, request: Request, next: Next) -> Response {
    let objection = guard.objection(request.method(), request.uri(), request.headers());
    let mut response = match objection {
        Some((status, words)) => (status, words).into_response(),
        None if request.method() == Method::GET => next.run(request).await,
        None => match tokio::time::timeout(WITHIN, next.run(request)).await {
            Ok(response) => response,
            Err(_) => (StatusCode::REQUEST_TIMEOUT, "the request took too long").into_response(),
        },
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

const HEADERS: [(&str, &str); 7] = [
    (
        "content-security-policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'none'",
    ),
    ("x-content-type-options", "nosniff"),
    ("x-frame-options", "DENY"),
    // The URL has the token in it.
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cache-control", "no-store"),
];
