//! The URLs of the server: whether a link belongs to it, and so may get the token; and where a
//! redirect leads. The syntax is that of RFC 3986, by the crate `fluent-uri`.

use std::net::Ipv4Addr;

use fluent_uri::pct_enc::{encoder, EString};
use fluent_uri::{Uri, UriRef};

/// The longest URL, in characters.
const MOST: usize = 4096;

/// The server: scheme, host, port, and the path before the tenant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Server {
    origin: String,
    path: String,
    plain: bool,
    local: bool,
}

impl Server {
    /// The server of a URL like `https://hawkbit.example.com/path`.
    ///
    /// # Errors
    /// In words, if it is no such URL.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        // It may have a password, which goes into no message.
        let wrong = |what: &str| format!("this is no URL of a server: {what}");
        let (url, origin) = requested(text)
            .ok_or_else(|| wrong("it must be like https://hawkbit.example.com, without a user name"))?;
        if url.has_query() || url.has_fragment() {
            return Err(wrong("it must end with the path"));
        }
        let host = url.authority().map(|authority| authority.host().to_ascii_lowercase()).unwrap_or_default();
        Ok(Self {
            plain: origin.starts_with("http:"),
            local: matches!(host.as_str(), "localhost" | "[::1]")
                || host.parse().is_ok_and(|address: Ipv4Addr| address.is_loopback()),
            path: url.path().as_str().trim_end_matches('/').to_string(),
            origin,
        })
    }

    /// Whether a token would go over a network as plain text.
    pub(super) fn is_open(&self) -> bool {
        self.plain && !self.local
    }

    /// Whether it is on this computer.
    pub(super) fn is_local(&self) -> bool {
        self.local
    }

    /// Whether it is reached over TLS.
    pub(super) fn is_tls(&self) -> bool {
        !self.plain
    }

    /// The URL of a device's root resource.
    pub(super) fn controller(&self, tenant: &str, controller: &str) -> String {
        let Self { origin, path, .. } = self;
        format!("{origin}{path}/{}/controller/v1/{}", encoded(tenant), encoded(controller))
    }

    /// The absolute form of a link, and whether it leads to this server. `None` if it is no URL
    /// that can be requested.
    pub(super) fn resolve(&self, link: &str) -> Option<(String, bool)> {
        let absolute = match link.starts_with('/') && !link.starts_with("//") {
            true => format!("{}{link}", self.origin),
            false => link.to_string(),
        };
        let (url, origin) = requested(&absolute)?;
        Some((url.strip_fragment().as_str().to_string(), origin == self.origin))
    }
}

/// Where a redirect leads: its `Location` is a reference relative to the URL that was asked for
/// (RFC 9110 section 10.2.2).
///
/// # Errors
/// In words, for what is no URL that can be requested, and for a way from https to http.
pub(super) fn redirected(from: &str, location: &str) -> Result<String, &'static str> {
    let (to, is_tls) = join(from, location)
        .ok_or("the server redirects to what is no URL of a server: check its address and its proxy")?;
    let was_tls = requested(from).is_some_and(|(_, origin)| origin.starts_with("https:"));
    match was_tls && !is_tls {
        true => Err("the server redirects from https to http, which is not followed: \
                     let it, or the proxy before it, redirect to https"),
        false => Ok(to),
    }
}

/// The URL that a reference names where `base` was asked for (RFC 3986 section 5.2), without a
/// fragment, and whether it is https. `None` if it is none that can be requested.
fn join(base: &str, reference: &str) -> Option<(String, bool)> {
    let url = UriRef::parse(reference).ok()?.resolve_against(&Uri::parse(base).ok()?).ok()?;
    let (url, origin) = requested(url.strip_fragment().as_str())?;
    Some((url.as_str().to_string(), origin.starts_with("https:")))
}

/// A URL that can be requested, and its origin in one form: scheme and host in small letters, with
/// the port. A user name before the host is refused: it would be a password in a configuration, or a
/// disguise in a link.
fn requested(text: &str) -> Option<(Uri<&str>, String)> {
    let url = Uri::parse(text).ok().filter(|_| text.len() <= MOST)?;
    let scheme = url.scheme().as_str().to_ascii_lowercase();
    let usual = match scheme.as_str() {
        "http" => 80,
        "https" => 443,
        _ => return None,
    };
    let authority = url.authority().filter(|authority| !authority.has_userinfo())?;
    let host = Some(authority.host().to_ascii_lowercase()).filter(|host| !host.is_empty())?;
    let port = authority.port_to_u16().ok()?.unwrap_or(usual);
    Some((url, format!("{scheme}://{host}:{port}")))
}

/// A text as one segment of a path.
fn encoded(segment: &str) -> EString<encoder::Path> {
    let mut out = EString::new();
    out.encode_str::<encoder::Data>(segment);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_the_servers_own_only_with_the_same_scheme_host_and_port() {
        let server = Server::parse("https://Hawk.example.com/ota/").unwrap();
        assert_eq!(
            server.controller("DEFAULT", "door 7/a"),
            "https://hawk.example.com:443/ota/DEFAULT/controller/v1/door%207%2Fa"
        );
        for (link, own) in [
            ("https://hawk.example.com/x?c=-5", Some(true)),
            ("https://HAWK.example.com:443/x", Some(true)),
            ("/ota/x", Some(true)),
            ("http://hawk.example.com/x", Some(false)),
            ("https://hawk.example.com:8443/x", Some(false)),
            ("https://hawk.example.com.evil.org/x", Some(false)),
            ("https://hawk.example.com@evil.org/x", None),
            ("//evil.org/x", None),
            ("https:/hawk.example.com", None),
            ("file:///etc/passwd", None),
            ("https://hawk.example.com/a b", None),
            ("https://hawk.example.com/\r\nX: y", None),
            ("https://:443/x", None),
            ("https://hawk.example.com:99999/x", None),
            ("", None),
        ] {
            assert_eq!(server.resolve(link).map(|(_, own)| own), own, "{link}");
        }
        assert!(Server::parse("https://h/x?y").is_err());
    }

    /// Some examples of RFC 3986 sections 5.4.1 and 5.4.2: the library has them all.
    #[test]
    fn a_reference_is_resolved_as_the_standard_does() {
        for (reference, url) in [
            ("g;x?y#s", "http://a/b/c/g;x?y"),
            ("?y", "http://a/b/c/d;p?y"),
            ("/g", "http://a/g"),
            ("//g", "http://g"),
            ("../../../g", "http://a/g"),
            ("", "http://a/b/c/d;p?q"),
            ("https://h", "https://h"),
            ("HTTP://h:80/x?y", "HTTP://h:80/x?y"),
        ] {
            assert_eq!(redirected("http://a/b/c/d;p?q", reference).as_deref(), Ok(url), "{reference}");
        }
        assert_eq!(redirected("http://a", "g").as_deref(), Ok("http://a/g"));
        assert_eq!(redirected("http://a?x=/y/", "g").as_deref(), Ok("http://a/g"));
        let long = "x/".repeat(MOST);
        for reference in [
            "g:h",
            "http:g",
            "http://",
            "http:///x",
            "//",
            "//u@g/",
            "ftp://g",
            "mailto:x",
            "a b",
            "\u{e4}",
            &long,
        ] {
            let why = redirected("http://a/b/c/d;p?q", reference).unwrap_err();
            assert!(why.contains("no URL of a server"), "{reference}: {why}");
        }
    }

    #[test]
    fn no_redirect_leads_from_https_to_http() {
        for location in ["http://h/x", "HTTP://h/x", "http://h:443/x", "http://other/"] {
            assert!(redirected("https://h/y", location).unwrap_err().contains("https to http"), "{location}");
        }
        for location in ["x", "//other/x", "https://other/x"] {
            assert!(redirected("https://h/y", location).unwrap().starts_with("https://"), "{location}");
        }
        assert_eq!(redirected("http://h/y", "https://h/y").as_deref(), Ok("https://h/y"));
    }

    #[test]
    fn a_token_goes_in_the_open_only_within_this_computer() {
        for (url, open) in [
            ("https://h", false),
            ("http://127.0.0.1:8080", false),
            ("http://[::1]:8080", false),
            ("http://localhost", false),
            ("http://hawkbit", true),
            ("http://127.evil.org.", true),
        ] {
            assert_eq!(Server::parse(url).unwrap().is_open(), open, "{url}");
        }
    }
}
