//! Parses the lines of a CiA 309-3 gateway.

use canopen::NodeId;

use crate::digits::decimal;

/// The first word of an answer or an event that reports an error.
pub(super) const ERROR: &str = "ERROR";
/// The event code of a boot-up message.
const BOOT_UP: u32 = 205;

/// A line of the gateway.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Line {
    /// The answer to the command with this number.
    Answer(u32, String),
    /// The rest of an answer that the gateway began and could not finish (CANopenNode).
    Broken(String),
    /// A node of this network has booted up.
    BootUp(u32, NodeId),
    /// Another event of the network.
    Event,
}

/// Parses a line; `None` if no gateway sends such a line.
pub(super) fn parse(text: &str) -> Option<Line> {
    let text = text.trim();
    if let Some(rest) = text.strip_prefix('[') {
        let (number, answer) = rest.split_once(']')?;
        return Some(Line::Answer(decimal(number.trim())?, answer.trim().to_string()));
    }
    if let Some(error) = text.strip_prefix("...").filter(|rest| rest.starts_with(ERROR)) {
        return Some(Line::Broken(error.to_string()));
    }
    // An event: network and node if the event has them, and a word.
    let words: Vec<&str> = text.split_ascii_whitespace().collect();
    let number = |at: usize| words.get(at).and_then(|word| word.parse::<u32>().ok());
    let (network, node) = (number(0), number(0).and(number(1)));
    let first = usize::from(network.is_some()) + usize::from(node.is_some());
    let name = words.get(first)?.trim_end_matches(':');
    if name.is_empty() || !name.bytes().all(|byte| byte.is_ascii_uppercase() || byte == b'_') {
        return None;
    }
    let node = node.and_then(|node| u8::try_from(node).ok()).and_then(NodeId::new);
    Some(match (name, network, node, number(first + 1)) {
        (ERROR, Some(network), Some(node), Some(BOOT_UP)) => Line::BootUp(network, node),
        _ => Line::Event,
    })
}

/// The error code of an answer: `None` if the answer is not an error, `Some(None)` for an error
/// without a code.
pub(super) fn error(answer: &str) -> Option<Option<u32>> {
    let rest = answer.strip_prefix(ERROR)?.trim_start_matches([':', ' ']);
    let word = rest.split([' ', '#', '(']).next().unwrap_or_default();
    Some(match word.strip_prefix("0x").or_else(|| word.strip_prefix("0X")) {
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => word.parse().ok(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_told_from_what_no_gateway_says() {
        let node = NodeId::new(5).unwrap();
        for (text, line) in [
            ("1 5 ERROR 205", Some(Line::BootUp(1, node))),
            ("1 5 ERROR: 205 (Boot-up)", Some(Line::BootUp(1, node))),
            ("2 5 ERROR 205", Some(Line::BootUp(2, node))),
            ("1 128 ERROR 205", Some(Line::Event)),
            ("1 5 ERROR 203", Some(Line::Event)),
            ("1 5 EMCY 8130 11 1 2 3 4 5", Some(Line::Event)),
            ("SYNC", Some(Line::Event)),
            ("1 2 3", None),
            ("hello", None),
            ("", None),
            ("[1 OK", None),
            ("[] OK", None),
            ("[+1] OK", None),
            ("[4294967296] OK", None),
        ] {
            assert_eq!(parse(text), line, "{text}");
        }
    }
}
