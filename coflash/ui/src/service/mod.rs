//! The service station (`coflash ui --service`): a page for people who update machines and need to know
//! nothing about CANopen. Package or job, options and folder of the reports are fixed; there is no LSS, no erase
//! and no choice of a file.
//!
//! `coflash_core::machine` scans, matches, plans and writes; [`work`] calls it, and the page shows what is
//! in [`station`]. All texts for people are in one table, `page/words.json`, in each language.
//!
//! | module | what it does |
//! |---|---|
//! | `setup` | what a station works with |
//! | `station` | its state, and what the page shows of it |
//! | `row` | the devices of a plan or an update |
//! | `requests` | what is answered to which request |
//! | `work` | the search and the update, by `coflash-core` |
//! | `message` | a key of the table, with its values |
//! | `trouble` | which message an error has |
//! | `report` | what became of a device, and of the machine; in CSV |
//! | `sheet` | the same in HTML, to print and to sign |
//! | `folder` | the folder of the reports |
//! | `words` | the table of texts |

use std::sync::Arc;

use self::station::Station;
use super::http::Page;

pub use self::setup::{Origin, Service};

mod folder;
mod message;
mod report;
mod requests;
mod row;
mod setup;
mod sheet;
mod station;
mod trouble;
mod words;
mod work;

impl Service {
    /// The page, and what becomes of its reports at the end.
    pub(super) fn open(self) -> (Page, AtEnd) {
        let station = Arc::new(Station::new(self));
        let page = requests::page(&station);
        (page, AtEnd(station))
    }
}

/// A station at its end.
pub(super) struct AtEnd(Arc<Station>);

impl AtEnd {
    /// Saves the reports that are not saved yet. What cannot be saved is returned in words.
    pub(super) fn save(&self) -> Option<String> {
        self.0.save();
        self.0.unsaved_words()
    }
}
