//! Which crate a symbol comes from, as far as its mangled name tells.

/// The crate that a symbol was made from; `None` for a name that is not Rust's (`memcpy`, `Reset`,
/// …).
///
/// Of `<Type as Trait>::method` it is the crate of `Type`, where that is a path. The legacy scheme
/// (`_ZN4core3fmt…17h…E`) and v0 (`_RNv…C…_4core…`, RFC 2603) are both read, since which one is
/// the compiler's default depends on its version.
pub fn crate_of(symbol: &str) -> Option<&str> {
    if let Some(path) = symbol.strip_prefix("_ZN") {
        let first = counted(path)?;
        let inner = first.trim_start_matches('_');
        return match inner.strip_prefix("$LT$") {
            // `<dyn T as …>`, `<&mut T …>`: step over what stands before the path.
            Some(mut inner) => {
                while let Some(rest) = ["dyn$u20$", "$RF$", "mut$u20$", "$u5b$", "$LP$"]
                    .iter()
                    .find_map(|prefix| inner.strip_prefix(prefix))
                {
                    inner = rest;
                }
                Some(word(inner)).filter(|name| !name.is_empty())
            }
            None => Some(first),
        };
    }
    let path = symbol.strip_prefix("_R")?;
    // The first crate root of the path: `C`, an optional disambiguator `s…_`, and the counted name.
    path.char_indices().filter(|&(_, letter)| letter == 'C').find_map(|(at, _)| {
        let rest = &path[at + 1..];
        let rest = match rest.strip_prefix('s') {
            Some(rest) => {
                let (disambiguator, rest) = rest.split_once('_')?;
                disambiguator.bytes().all(|byte| byte.is_ascii_alphanumeric()).then_some(rest)?
            }
            None => rest,
        };
        let (len, name) = rest.split_at(rest.find(|c: char| !c.is_ascii_digit())?);
        // A `_` stands between where the name itself starts with a digit or a `_`.
        let name = name.strip_prefix('_').unwrap_or(name);
        name.get(..len.parse().ok()?).filter(|name| !name.is_empty() && *name == word(name))
    })
}

/// The name in `<length><that many bytes>…`.
fn counted(text: &str) -> Option<&str> {
    let (len, name) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    name.get(..len.parse().ok()?).filter(|name| !name.is_empty())
}

/// The identifier at the start of a text.
fn word(text: &str) -> &str {
    let end = text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
    &text[..end]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_schemes_are_read() {
        // Legacy names as `nm` shows them for rustc's own libraries.
        assert_eq!(crate_of("_ZN4core3fmt5write17h0123456789abcdefE"), Some("core"));
        assert_eq!(
            crate_of("_ZN64_$LT$bxcan..Can$LT$I$GT$$u20$as$u20$core..ops..drop..Drop$GT$4drop17h01E"),
            Some("bxcan")
        );
        assert_eq!(crate_of("_ZN44_$LT$$RF$T$u20$as$u20$core..fmt..Display$GT$3fmt17h01E"), Some("T"));
        // Examples of RFC 2603.
        assert_eq!(crate_of("_RNvNtCs1234_7mycrate3foo3bar"), Some("mycrate"));
        assert_eq!(crate_of("_RNvC7mycrate3foo"), Some("mycrate"));
        assert_eq!(crate_of("_RNvC6_123foo3bar"), Some("123foo"));
    }

    #[test]
    fn other_names_are_nobody_s() {
        for name in
            ["memcpy", "", "_ZN", "_ZN99core", "_R", "_RC", "_RNvCs_", "_ZN0E", "__cortex_m_x", "_ZNé"]
        {
            assert_eq!(crate_of(name), None, "{name}");
        }
    }
}
