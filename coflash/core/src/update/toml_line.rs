//! The line of an error in TOML.

/// The number of the line with the error in TOML, counted from 1.
pub(crate) fn line_of(text: &str, error: &toml::de::Error) -> usize {
    line_in(text, error.span().map_or(0, |span| span.start))
}

/// The number of the line with this byte, counted from 1.
pub(crate) fn line_in(text: &str, at: usize) -> usize {
    1 + text.get(..at).unwrap_or_default().matches('\n').count()
}
