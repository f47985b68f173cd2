//! What the server hears of an update: its news, and its end.

use coflash_core::update::event::Phase;
use coflash_core::update::many::Failed;
use coflash_core::update::{DeviceState, Event};
use coflash_core::Error;

use super::controller::News;

/// The news in an event of an update.
pub(super) fn news_of(event: &Event) -> Vec<News> {
    let phase = News::Phase(event.to_string());
    match event {
        Event::Progress { done, total } => {
            let percent = (done * 100).checked_div(*total).unwrap_or(100);
            vec![News::Percent(u8::try_from(percent).unwrap_or(100))]
        }
        Event::Phase(Phase::Released | Phase::Started(_) | Phase::Installed { .. }) => {
            vec![News::Kept, phase]
        }
        Event::Done(_) => Vec::new(),
        _ => vec![phase],
    }
}

/// Why the bus or the device cannot be used now, if that is all that is wrong: nothing was changed.
pub(super) fn not_now(error: &Error) -> Option<String> {
    matches!(error, Error::Adapter(_) | Error::NotAlone { .. })
        .then(|| format!("{error}: {}", error.advice()))
}

/// The same of an update that has failed.
pub(super) fn waits(Failed { error, left }: &Failed) -> Option<String> {
    not_now(error).filter(|_| left.state == DeviceState::Untouched)
}

/// What happened, the state of the device, and what to do.
pub(super) fn failure(Failed { error, left }: &Failed) -> [String; 3] {
    [
        format!("{error} [{:#010X}]", error.number()),
        format!("the device: {left}"),
        format!("what to do: {}", error.advice()),
    ]
}
