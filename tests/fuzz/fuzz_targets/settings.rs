//! Recipe (also as a job file) and configuration file.
//!
//! Must hold: any text gives a recipe, settings, or a fault with a place inside the text; each device
//! of a recipe has an image and a name, and no two are equal; each setting exists and has a value of
//! its kind.
#![cfg_attr(fuzzing, no_main)]

use std::path::Path;

use coflash_core::machine::{Recipe, RecipeFault};
use coflash_core::update::config::{self, Setting};

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
    let recipe = Recipe::parse(text, Path::new("folder"));
    match recipe.as_ref().map_err(Clone::clone).and_then(Recipe::devices) {
        Err(RecipeFault::Line(line, what)) => assert!((1..=lines).contains(&line) && !what.is_empty()),
        Err(RecipeFault::Program(number, what)) => assert!(number >= 1 && !what.is_empty()),
        Ok(devices) => {
            assert!(!devices.is_empty());
            for (i, device) in devices.iter().enumerate() {
                assert!(device.node.is_some() || device.address.is_some());
                assert!(device.row.program.is_none_or(|program| (1..=254).contains(&program)));
                for other in &devices[..i] {
                    assert!(device.node.is_none() || device.node != other.node);
                    assert!(device.address.is_none() || device.address != other.address);
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
