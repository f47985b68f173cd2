//! What the server hears of an update: its news, and its end.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use canopen::{Frame, NodeId};
use coboot_can::{wall, Link, Tap};
use coflash_core::update::event::Phase;
use coflash_core::update::many::Failed;
use coflash_core::update::{DeviceState, Event, Histories};
use coflash_core::Error;

use super::controller::News;

/// What the devices of a bus have shown.
#[derive(Clone, Debug, Default)]
pub(super) struct Shown(Arc<Mutex<Histories>>);

impl Shown {
    /// The link, of which each frame is heard. Behind a gateway there are none.
    pub(super) fn on(&self, link: Link) -> Link {
        let Link::Bus(adapter) = link else { return link };
        let histories = self.0.clone();
        let ear = move |time: Duration, frame: &Frame, _: bool| {
            histories.lock().unwrap_or_else(PoisonError::into_inner).saw(time, frame);
        };
        Link::Bus(Box::new(Tap::new(adapter, Box::new(ear))))
    }

    /// The news in an event of an update of this node.
    pub(super) fn news(&self, node: NodeId, event: &Event) -> Vec<News> {
        let failed = self.0.lock().unwrap_or_else(PoisonError::into_inner).record(wall(), node, event);
        let mut news = news_of(event);
        news.extend(failed.map(News::Failed));
        news
    }
}

fn news_of(event: &Event) -> Vec<News> {
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
    let is_in_use = matches!(error, Error::Adapter(_) | Error::NotAlone { .. }) || error.refuses_now();
    is_in_use.then(|| format!("{error}: {}", error.advice()))
}

/// The same of an update that has failed.
pub(super) fn waits(Failed { error, left }: &Failed) -> Option<String> {
    // What an earlier attempt may have changed, this one has not.
    not_now(error).filter(|_| matches!(left.state, DeviceState::Untouched | DeviceState::Begun))
}

/// What happened, the state of the device, what it has answered, and what to do.
pub(super) fn failure(Failed { error, left }: &Failed) -> Vec<String> {
    let answers = error.answers().into_iter().map(|answer| format!("it answered: {answer}"));
    let mut lines = vec![format!("{error} [{:#010X}]", error.number()), format!("the device: {left}")];
    lines.extend(answers);
    lines.push(format!("what to do: {}", error.advice()));
    lines
}
