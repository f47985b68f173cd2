//! Checks who sends a request: only a page of this server, opened by the user who started it, is
//! accepted.
//!
//! The token is a part of the URL's path and not a cookie: browsers send a cookie to all ports of a
//! host, so another server on this computer would get it.

use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::{header, HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::firmware::FILE_MAX;
use super::guests::Guest;

/// How long a request with a body may take until it is answered.
const WITHIN: Duration = Duration::from_secs(60);

/// The data that a request must contain.
#[derive(Clone, Debug)]
pub(super) struct Guard {
    pub(super) token: String,
    pub(super) port: u16,
}

impl Guard {
    /// A token that cannot be guessed: 128 bits of the system's random numbers.
    pub(super) fn token() -> Result<String, getrandom::Error> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes)?;
        Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Why a request is refused, if it is.
    fn objection(
        &self,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Option<(StatusCode, &'static str)> {
        let forbidden = |words| Some((StatusCode::FORBIDDEN, words));
        let hosts = [format!("127.0.0.1:{}", self.port), format!("localhost:{}", self.port)];
        let values = |name| headers.get_all(name).iter().map(|value| value.to_str().unwrap_or_default());
        if values(header::HOST).count() > 1 {
            let words = "a request must have one Host header, and this one has several";
            return Some((StatusCode::BAD_REQUEST, words));
        }
        // A foreign name that resolves to 127.0.0.1 is refused, in the header and in the request line.
        let mut names =
            values(header::HOST).chain(uri.authority().map(|authority| authority.as_str())).peekable();
        if names.peek().is_none() || !names.all(|name| hosts.iter().any(|own| own == name)) {
            return forbidden("this server is only available as 127.0.0.1");
        }
        let own_origin = |origin: &str| {
            origin.strip_prefix("http://").is_some_and(|origin| hosts.iter().any(|own| own == origin))
        };
        if !values(header::ORIGIN).all(own_origin) {
            return forbidden("requests from pages of another origin are refused");
        }
        // Browsers name the origin of a request: this page, or (none) the user. The page alone may be opened from
        // elsewhere: the file that leads to it is of another origin.
        let values_of = |name| values(HeaderName::from_static(name)).collect::<Vec<_>>();
        let is_page = *method == Method::GET && uri.path().splitn(3, '/').nth(2) == Some("");
        let sites = values_of("sec-fetch-site");
        let is_own = sites.iter().all(|site| matches!(*site, "same-origin" | "none"));
        let is_opened = is_page
            && (&*values_of("sec-fetch-mode"), &*values_of("sec-fetch-dest"))
                == (&["navigate"], &["document"])
            && sites == ["cross-site"];
        if !is_own && !is_opened {
            return forbidden("requests from pages of another origin are refused");
        }
        let shown = uri.path().strip_prefix('/').and_then(|path| path.split('/').next()).unwrap_or_default();
        if !same(shown.as_bytes(), self.token.as_bytes()) {
            return forbidden("the token is missing or wrong: open the URL that coflash has printed");
        }
        // A body with an announced length that is too large is refused before it is read.
        let mut lengths = values(header::CONTENT_LENGTH).filter_map(|len| len.parse::<u64>().ok());
        if lengths.any(|len| len > FILE_MAX as u64) {
            return Some((StatusCode::PAYLOAD_TOO_LARGE, "the file is larger than any program"));
        }
        if !matches!(*method, Method::GET | Method::POST) {
            return Some((StatusCode::METHOD_NOT_ALLOWED, "only GET and POST are supported"));
        }
        None
    }
}

/// Compares in constant time.
fn same(one: &[u8], other: &[u8]) -> bool {
    one.len() == other.len() && one.iter().zip(other).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

/// The first layer of the server: refuses requests without permission, and adds the headers that
/// protect the page to each answer.
pub(super) async fn guard(State(guard): State<Guard>, request: Request, next: Next) -> Response {
    let objection = guard.objection(request.method(), request.uri(), request.headers());
    if let (None, Some(guest)) = (objection, request.extensions().get::<Guest>()) {
        guest.admit();
    }
    let mut response = match objection {
        Some((status, words)) => (status, words).into_response(),
        None if request.method() == Method::GET => next.run(request).await,
        None => match tokio::time::timeout(WITHIN, next.run(request)).await {
            Ok(response) => response,
            Err(_) => (StatusCode::REQUEST_TIMEOUT, "the request took too long").into_response(),
        },
    };
    for (name, value) in HEADERS {
        // A report has a policy of its own.
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
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
    // The URL contains the token.
    ("referrer-policy", "no-referrer"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cache-control", "no-store"),
];
