//! The URLs of the server: whether a link belongs to it, and so may get the token.

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
