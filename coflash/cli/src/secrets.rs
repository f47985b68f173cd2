//! Removes passwords from a command line, and tokens from URLs, for records that users pass on.

use std::ffi::OsString;

use coboot_can::redact::is_password;

use super::values::address;

/// The options with a secret value. A command that switches the power may have the password of a
/// relay.
const SECRET: [&str; 4] = ["--unlock", "--key", "--of-value", "--power-command"];

/// The replacement for a password.
pub(super) const HIDDEN: &str = "***";

/// The words with the secrets hidden: the values of the options with one, and the passwords that
/// the command writes into an object, if it writes one.
pub(super) fn without(words: &[OsString], passwords: &[&str]) -> Vec<String> {
    let mut hide = false;
    let shown = |word: &OsString| {
        let word = word.to_string_lossy().into_owned();
        if std::mem::take(&mut hide) || passwords.contains(&word.as_str()) {
            return HIDDEN.to_string();
        }
        if let Some(option) = SECRET.iter().find(|option| word.starts_with(&format!("{option}="))) {
            return format!("{option}={HIDDEN}");
        }
        hide = SECRET.contains(&word.as_str());
        word
    };
    words.iter().map(shown).collect()
}

/// Whether a line of the shell has a secret: it is not kept for the next start. What an object with
/// a name is, only its sheet says.
pub(super) fn are_in(line: &[String]) -> bool {
    let words: Vec<OsString> = line.iter().map(OsString::from).collect();
    let mut objects = line.iter().filter(|word| word.len() >= 4).filter_map(|word| address(word)).peekable();
    let may_be_password = objects.peek().is_none() || objects.any(is_password);
    line.iter().any(|word| word == "write") && may_be_password || without(&words, &[]) != line
}

/// The text with the secrets of its URLs hidden: user names and passwords, queries and fragments,
/// and the paths of web servers, since that of `coflash ui` is a token. Messages name an adapter
/// without the scheme of its URL, so a word need not have one.
pub(super) fn without_urls(text: &str) -> String {
    // A password may have any other character. JSON ends a text with a quotation mark.
    let ends = |c: char| c.is_whitespace() || c == '"';
    let mut shown = String::new();
    for part in text.split_inclusive(ends) {
        let word = part.trim_end_matches(|c: char| ends(c) || "\\,.;:)'`>".contains(c));
        match word.split_once("://") {
            Some((scheme, rest)) => {
                let is_web = ["http", "https"].iter().any(|web| scheme.to_lowercase().ends_with(web));
                let (rest, fragment) = hidden_from(rest, '#');
                let rest = without_secrets(rest, is_web);
                shown.push_str(&format!("{scheme}://{rest}{fragment}"));
            }
            None => shown.push_str(&without_secrets(word, false)),
        }
        shown.push_str(&part[word.len()..]);
    }
    shown
}

/// What is before a mark, and the mark with what follows it hidden, if anything does.
fn hidden_from(text: &str, mark: char) -> (&str, String) {
    match text.split_once(mark) {
        Some((before, after)) if !after.is_empty() => (before, format!("{mark}{HIDDEN}")),
        _ => (text, String::new()),
    }
}

/// A URL without its scheme, with its secrets hidden.
fn without_secrets(text: &str, is_web: bool) -> String {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let (place, query) = match text.split_once('?') {
        // The speed of a serial line.
        Some((place, query)) if query.strip_prefix("baud=").is_some_and(is_number) => {
            (place, format!("?{query}"))
        }
        _ => hidden_from(text, '?'),
    };
    // A bit rate is after the last @ of an adapter's URL.
    let is_rate = |text: &str| is_number(text.trim_end_matches(['k', 'K', 'M']));
    let (place, rate) = match place.rsplit_once('@') {
        Some((place, rate)) if is_rate(rate) => (place, format!("@{rate}")),
        _ => (place, String::new()),
    };
    let place = match place.rsplit_once('@') {
        Some((user, host)) if !user.is_empty() && !host.is_empty() => format!("{HIDDEN}@{host}"),
        _ => place.to_owned(),
    };
    match place.split_once('/') {
        Some((host, path)) if is_web && !path.is_empty() => format!("{host}/{HIDDEN}{query}"),
        _ => format!("{place}{rate}{query}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_hidden() {
        for (words, shown) in [
            ("coflash flash a --unlock sesame -N 5", "coflash flash a --unlock *** -N 5"),
            ("coflash flash a --unlock=sesame", "coflash flash a --unlock=***"),
            ("coflash convert a --key 1234 --add 1", "coflash convert a --key *** --add 1"),
            (
                "coflash seal keys new --role kek --of-value 12",
                "coflash seal keys new --role kek --of-value ***",
            ),
            ("coflash write 6005/1 Sesam --type string", "coflash write 6005/1 *** --type string"),
            ("coflash write 6005/1 --type string Sesam", "coflash write 6005/1 --type string ***"),
            ("coflash flash a --unlock", "coflash flash a --unlock"),
            ("more conform --power-command=relay:pw", "more conform --power-command=***"),
        ] {
            let words: Vec<OsString> = words.split(' ').map(OsString::from).collect();
            assert_eq!(without(&words, &["Sesam"]).join(" "), shown);
        }
    }

    #[test]
    fn a_line_with_a_secret_is_not_kept() {
        let is_kept = |line: &str| !are_in(&line.split(' ').map(String::from).collect::<Vec<_>>());
        assert!(is_kept("flash a -N 5") && is_kept("write 1017 500") && !is_kept("flash a --unlock=x"));
        assert!(!is_kept("-N 5 write 6005/1 abcd") && !is_kept("write Code abc -N 5"));
    }

    #[test]
    fn the_secrets_of_urls_are_hidden() {
        for (text, shown) in [
            ("bus slcan:tcp://10.0.0.7:2000@500k, and", "bus slcan:tcp://10.0.0.7:2000@500k, and"),
            ("socketcand://me:sesame@host:29536/can0", "socketcand://***@host:29536/can0"),
            ("slcan:tcp://me:sesame@host:2000@500k", "slcan:tcp://***@host:2000@500k"),
            ("cia309://host:1/1?key=sesame", "cia309://host:1/1?***"),
            ("{\"url\":\"http://127.0.0.1:80/sesame/\"}", "{\"url\":\"http://127.0.0.1:80/***\"}"),
            ("see https://me:ses@me@host/a/sesame#sesame.", "see https://***@host/***#***."),
            (
                "(socketcand me:ses,ame@10.0.0.7:1, bus can0?token=sesame cannot be opened)",
                "(socketcand ***@10.0.0.7:1, bus can0?*** cannot be opened)",
            ),
            ("slcan:tcp://host:2000@500k. Why? \"a\\\"\"", "slcan:tcp://host:2000@500k. Why? \"a\\\"\""),
            ("slcan:/dev/ttyACM0@500k 605#2B17", "slcan:/dev/ttyACM0@500k 605#2B17"),
            ("slcan:COM3@125k?baud=57600, and", "slcan:COM3@125k?baud=57600, and"),
            ("slcan:COM3@125k?baud=57600&key=sesame", "slcan:COM3@125k?***"),
        ] {
            assert_eq!(without_urls(text), shown);
        }
    }
}
