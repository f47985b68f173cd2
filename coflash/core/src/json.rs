//! The JSON forms of values, with the names and formats that `--json` and the events share.

use std::time::Duration;

use canopen::program::FlashStatus;
use canopen::NodeId;
use serde::ser::SerializeStruct as _;
use serde::{Serialize as _, Serializer};

/// A node-ID as a number.
pub(crate) fn node<S: Serializer>(node: &NodeId, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u8(node.get())
}

/// A time in seconds, with milliseconds.
pub(crate) fn seconds<S: Serializer>(time: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64((time.as_secs_f64() * 1000.0).round() / 1000.0)
}

/// An error number in the form of the messages: `0x60000013`.
pub(crate) fn hex<S: Serializer>(number: &u32, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{number:#010x}"))
}

/// Ids in the form of the messages: `89ABCDEFh`.
pub(crate) fn ids<S: Serializer>(ids: &[u32], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(ids.iter().map(|id| format!("{id:08X}h")))
}

/// The status in 1F57h.
pub(crate) fn status<S: Serializer>(status: &Option<FlashStatus>, serializer: S) -> Result<S::Ok, S::Error> {
    let Some(status) = status else { return None::<()>.serialize(serializer) };
    let mut fields = serializer.serialize_struct("FlashStatus", 5)?;
    fields.serialize_field("word", &status.to_word())?;
    fields.serialize_field("busy", &status.busy)?;
    fields.serialize_field("error", &status.error.map(|error| error.code()))?;
    fields.serialize_field("error_text", &status.error.map(|error| error.to_string()))?;
    fields.serialize_field("detail", &status.detail)?;
    fields.end()
}

/// A value as its text for people.
pub(crate) fn words<T: std::fmt::Display, S: Serializer>(
    value: &T,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_str(value)
}
