//! The URLs of the server: whether a link belongs to it, and so may get the token; and where a
//! redirect leads.

use std::net::Ipv4Addr;

/// The server: scheme, host, port, and the path before the tenant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Server {
    origin: String,
    path: String,
    plain: bool,
    local: bool,
}

/// An absolute URL in two parts.
struct Parts<'u> {
    /// Scheme, host and port in one form: in small letters, with the port.
    origin: String,
    /// From the first slash after the host on.
    rest: &'u str,
    host: String,
}

impl Server {
    /// The server of a URL like `https://hawkbit.example.com/path`.
    ///
    /// # Errors
    /// In words, if it is no such URL.
    pub(super) fn parse(url: &str) -> Result<Self, String> {
        let wrong = |what: &str| format!("'{url}' is no URL of a server: {what}");
        let parts = split(url).ok_or_else(|| wrong("it must be like https://hawkbit.example.com"))?;
        if parts.rest.contains(['?', '#']) {
            return Err(wrong("it must end with the path"));
        }
        Ok(Self {
            plain: parts.origin.starts_with("http:"),
            local: matches!(parts.host.as_str(), "localhost" | "[::1]")
                || parts.host.parse().is_ok_and(|address: Ipv4Addr| address.is_loopback()),
            path: parts.rest.trim_end_matches('/').to_string(),
            origin: parts.origin,
        })
    }

    /// Whether a token would go over a network as plain text.
    pub(super) fn is_open(&self) -> bool {
        self.plain && !self.local
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
        if link.starts_with('/') && !link.starts_with("//") && is_clean(link) {
            return Some((format!("{}{link}", self.origin), true));
        }
        let own = split(link)?.origin == self.origin;
        Some((link.split('#').next().unwrap_or(link).to_string(), own))
    }
}

/// Where a redirect leads: its `Location` is a reference relative to the URL that was asked for
/// (RFC 9110 section 10.2.2).
///
/// # Errors
/// In words, for what is no URL that can be requested, and for a way from https to http.
pub(super) fn redirected(from: &str, location: &str) -> Result<String, &'static str> {
    let to = join(from, location)
        .ok_or("the server redirects to what is no URL of a server: check its address and its proxy")?;
    let is_tls = |url: &str| split(url).is_some_and(|parts| parts.origin.starts_with("https:"));
    match is_tls(from) && !is_tls(&to) {
        true => Err("the server redirects from https to http, which is not followed: \
                     let it, or the proxy before it, redirect to https"),
        false => Ok(to),
    }
}

/// The URL that a reference names where `base` was asked for (RFC 3986 section 5.2), without a
/// fragment. `None` if it is none that can be requested.
fn join(base: &str, reference: &str) -> Option<String> {
    let reference = reference.split('#').next().unwrap_or(reference);
    let (origin, rest) = cut(base)?;
    let (path, _) = query_of(rest);
    let absolute = match reference.as_bytes() {
        [] => base.to_string(),
        [b'/', b'/', ..] => format!("{}{reference}", &origin[..=origin.find(':')?]),
        [b'/', ..] => format!("{origin}{reference}"),
        [b'?', ..] => format!("{origin}{path}{reference}"),
        _ if has_scheme(reference) => reference.to_string(),
        _ => {
            let folder = path.rfind('/').map_or("/", |at| &path[..=at]);
            format!("{origin}{folder}{reference}")
        }
    };
    let (origin, rest) = cut(&absolute)?;
    let (path, query) = query_of(rest);
    Some(format!("{origin}{}{query}", without_dots(path)))
}

/// An absolute URL in two: up to the host, and from its path on.
fn cut(url: &str) -> Option<(&str, &str)> {
    let rest = split(url)?.rest.len();
    Some(url.split_at(url.len() - rest))
}

/// A path, and the query after it.
fn query_of(rest: &str) -> (&str, &str) {
    rest.split_at(rest.find('?').unwrap_or(rest.len()))
}

/// Whether a reference begins with a scheme (RFC 3986 section 3.1).
fn has_scheme(reference: &str) -> bool {
    reference.split_once(':').is_some_and(|(scheme, _)| {
        scheme.starts_with(|c: char| c.is_ascii_alphabetic())
            && scheme.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"+-.".contains(&byte))
    })
}

/// A path without the segments `.` and `..` (RFC 3986 section 5.2.4).
fn without_dots(path: &str) -> String {
    let mut kept = Vec::new();
    let mut segments = path.strip_prefix('/').unwrap_or(path).split('/').peekable();
    while let Some(segment) = segments.next() {
        match segment {
            "." => {}
            ".." => drop(kept.pop()),
            segment => kept.push(segment),
        }
        if segments.peek().is_none() && matches!(segment, "." | "..") {
            kept.push("");
        }
    }
    format!("/{}", kept.join("/"))
}

/// Whether a text has only characters that a URL may have.
fn is_clean(text: &str) -> bool {
    text.len() <= MOST && text.bytes().all(|byte| byte.is_ascii_graphic() && !b"\"<>\\^`{|}".contains(&byte))
}

/// The longest URL.
const MOST: usize = 4096;

fn split(url: &str) -> Option<Parts<'_>> {
    if !is_clean(url) {
        return None;
    }
    let (scheme, behind) = url.split_once("://")?;
    let scheme = scheme.to_ascii_lowercase();
    let port = match scheme.as_str() {
        "http" => "80",
        "https" => "443",
        _ => return None,
    };
    let end = behind.find(['/', '?', '#']).unwrap_or(behind.len());
    let (host, rest) = behind.split_at(end);
    // A user name before the host would be a password in a configuration, or a disguise in a link.
    if host.contains('@') {
        return None;
    }
    let (name, given) = match host.rsplit_once(':') {
        Some((name, given)) if !given.contains(']') => (name, given),
        _ => (host, ""),
    };
    let given = if given.is_empty() { port } else { given };
    if name.is_empty() || given.parse::<u16>().is_err() {
        return None;
    }
    let host = name.to_ascii_lowercase();
    Some(Parts { origin: format!("{scheme}://{host}:{given}"), rest, host })
}

/// A text as one segment of a path.
fn encoded(segment: &str) -> String {
    let mut out = String::new();
    for byte in segment.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' => out.push(char::from(byte)),
            byte => out.push_str(&format!("%{byte:02X}")),
        }
    }
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

    /// The examples of RFC 3986 sections 5.4.1 and 5.4.2.
    #[test]
    fn a_reference_is_resolved_as_the_standard_does() {
        for (reference, url) in [
            ("g", "http://a/b/c/g"),
            ("./g", "http://a/b/c/g"),
            ("g/", "http://a/b/c/g/"),
            ("/g", "http://a/g"),
            ("//g", "http://g/"),
            ("?y", "http://a/b/c/d;p?y"),
            ("g?y", "http://a/b/c/g?y"),
            ("#s", "http://a/b/c/d;p?q"),
            ("g#s", "http://a/b/c/g"),
            ("g?y#s", "http://a/b/c/g?y"),
            (";x", "http://a/b/c/;x"),
            ("g;x?y#s", "http://a/b/c/g;x?y"),
            ("", "http://a/b/c/d;p?q"),
            (".", "http://a/b/c/"),
            ("./", "http://a/b/c/"),
            ("..", "http://a/b/"),
            ("../", "http://a/b/"),
            ("../g", "http://a/b/g"),
            ("../..", "http://a/"),
            ("../../g", "http://a/g"),
            ("../../../g", "http://a/g"),
            ("/./g", "http://a/g"),
            ("/../g", "http://a/g"),
            ("g.", "http://a/b/c/g."),
            ("..g", "http://a/b/c/..g"),
            ("./g/.", "http://a/b/c/g/"),
            ("g/./h", "http://a/b/c/g/h"),
            ("g/../h", "http://a/b/c/h"),
            ("g;x=1/../y", "http://a/b/c/y"),
            ("g?y/../x", "http://a/b/c/g?y/../x"),
            ("https://h", "https://h/"),
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
