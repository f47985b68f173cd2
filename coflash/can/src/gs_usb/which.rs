//! The part of the URL that selects the device.

use std::fmt;

use crate::digits::decimal;

/// The device, and its channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Which {
    pub(super) device: Choice,
    pub(super) channel: u8,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Choice {
    /// Its place in the list of devices.
    Place(usize),
    /// Its serial number.
    Serial(String),
}

impl Which {
    /// Parses `0`, `0/1` or `0030003A3438511834353732`. A number below 100 is a place, any other
    /// text a serial number.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        let (device, channel) = match text.split_once('/') {
            Some((device, channel)) => (device, Some(channel)),
            None => (text, None),
        };
        let channel = channel.map_or(Some(0), decimal)?;
        let device = match decimal(device) {
            _ if device.is_empty() => return None,
            Some(place) if device.len() <= 2 => Choice::Place(place),
            _ => Choice::Serial(device.to_string()),
        };
        Some(Self { device, channel })
    }
}

impl fmt::Display for Which {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.device {
            Choice::Place(place) => write!(f, "{place}")?,
            Choice::Serial(serial) => f.write_str(serial)?,
        }
        match self.channel {
            0 => Ok(()),
            channel => write!(f, "/{channel}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_named_by_place_or_serial_number() {
        let which = |text| Which::parse(text).map(|which| (which.device, which.channel));
        assert_eq!(which("0"), Some((Choice::Place(0), 0)));
        assert_eq!(which("12/1"), Some((Choice::Place(12), 1)));
        assert_eq!(which("0030003A"), Some((Choice::Serial("0030003A".to_string()), 0)));
        assert_eq!(which("1234/2"), Some((Choice::Serial("1234".to_string()), 2)));
        for bad in ["", "/0", "0/", "0/x", "0/256", "0/1/2"] {
            assert_eq!(which(bad), None, "{bad}");
        }
    }
}
