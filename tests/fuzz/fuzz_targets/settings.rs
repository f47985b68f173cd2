//! Job file and configuration file.
//!
//! Must hold: any text gives a job, settings, or a fault with a place inside the text; each device
//! of a job has an image and a name, and no two are equal; each setting exists and has a value of
//! its kind.
#![cfg_attr(fuzzing, no_main)]

use std::path::Path;

use coflash_core::update::config::{self, Setting};
use coflash_core::update::job;

/// The options of a tool, and whether each is a switch.
const KEYS: [(&str, bool); 7] = [
    ("bus", false),
    ("node", false),
    ("board", false),
    ("block-size", false),
    ("sdo-timeout", false),
    ("verify", true),
    ("json", true),
];

coboot_fuzz::target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let lines = text.matches('\n').count() + 1;
    match job::parse(text, Path::new("folder")) {
        Err(job::Fault::Line(line, what)) => assert!((1..=lines).contains(&line) && !what.is_empty()),
        Err(job::Fault::Device(number, what)) => assert!(number >= 1 && !what.is_empty()),
        Ok(entries) => {
            assert!(!entries.is_empty());
            for (i, entry) in entries.iter().enumerate() {
                assert!(entry.node.is_some() || entry.address.is_some());
                assert!(entry.settings.image.is_some());
                assert!(entry.settings.program.is_none_or(|program| (1..=254).contains(&program)));
                for other in &entries[..i] {
                    assert!(entry.node.is_none() || entry.node != other.node);
                    assert!(entry.address.is_none() || entry.address != other.address);
                }
            }
        }
    }
    let is_switch = |key: &str| KEYS.iter().find(|(known, _)| *known == key).map(|(_, switch)| *switch);
    match config::parse(text, &is_switch) {
        Err(config::Fault::Line(line, what)) => assert!((1..=lines).contains(&line) && !what.is_empty()),
        Err(config::Fault::Setting(what)) => assert!(!what.is_empty()),
        Ok(settings) => {
            for (key, setting) in &settings {
                assert_eq!(is_switch(key), Some(matches!(setting, Setting::Switch(_))), "{key}");
            }
        }
    }
});
