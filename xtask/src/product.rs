//! The product of a bootloader: the file with its choices, and its name.

use std::path::Path;

use crate::{outcome::Outcome, workspace};

/// A product of a bootloader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Product {
    /// Its name: that of its file, without `.rs`.
    pub name: String,
    /// The name of a file in `bootloader/products`, or the path of another file (bootloader/build.rs).
    pub choice: String,
}

/// The folder with the products of this repository.
pub const FOLDER: &str = "bootloader/products";
/// The product of a bootloader that names none.
const DEFAULT: &str = "default";

impl Product {
    /// The customer's, which has no name in the image: `bootloader/products/default.rs`.
    pub fn default() -> Self {
        Self { name: DEFAULT.to_owned(), choice: DEFAULT.to_owned() }
    }

    /// The product of a file in `bootloader/products`.
    pub fn named(name: &str) -> Outcome<Self> {
        let file = workspace::root().join(FOLDER).join(format!("{name}.rs"));
        if !is_name(name) || !file.exists() {
            return Err(format!("{FOLDER} has no {name}.rs: there is no product \"{name}\"."));
        }
        Ok(Self { name: name.to_owned(), choice: name.to_owned() })
    }

    /// The product of this file.
    pub fn of_file(file: &Path) -> Outcome<Self> {
        let path = file.canonicalize().map_err(|error| format!("{}: {error}.", file.display()))?;
        let name = path.file_stem().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
        if !is_name(&name) || name == DEFAULT {
            return Err(format!(
                "{}: small letters, digits and hyphens are the name of a product, and the name is in the \
                 image; \"{DEFAULT}\" is that of {FOLDER}/{DEFAULT}.rs.",
                file.display()
            ));
        }
        let choice = path.to_str().ok_or_else(|| format!("{}: this path is no text.", path.display()))?;
        Ok(Self { name, choice: choice.to_owned() })
    }

    /// The product that a command line names: by a path with `.rs`, or a name.
    pub fn chosen(word: &str) -> Outcome<Self> {
        if word.ends_with(".rs") {
            Self::of_file(Path::new(word))
        } else {
            Self::named(word)
        }
    }

    /// Whether this is `bootloader/products/default.rs`.
    pub fn is_default(&self) -> bool {
        self.name == DEFAULT
    }

    /// The arguments that choose the product for cargo. They override `.cargo/config.toml`, which
    /// chooses the default; a variable of the shell has no effect.
    pub fn args(&self) -> [String; 4] {
        let value = format!("env.COBOOT_PRODUCT.value={:?}", self.choice);
        ["--config", &value, "--config", "env.COBOOT_PRODUCT.force=true"].map(str::to_owned)
    }
}

/// Whether a text is the name of a product: it is part of a file's name and of 100Ah.
fn is_name(name: &str) -> bool {
    let is_good = |letter: char| letter.is_ascii_lowercase() || letter.is_ascii_digit() || letter == '-';
    (1..=32).contains(&name.len())
        && name.starts_with(|first: char| first != '-')
        && name.chars().all(is_good)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_product_is_a_name_or_a_file() {
        let lift = Product::chosen("lift").unwrap();
        assert_eq!(
            (lift.name.as_str(), lift.args()[1].as_str()),
            ("lift", "env.COBOOT_PRODUCT.value=\"lift\"")
        );
        let file = workspace::root().join(FOLDER).join("lift.rs");
        let same = Product::chosen(file.to_str().unwrap()).unwrap();
        assert_eq!(same.name, "lift");
        assert!(same.args()[1].ends_with("/bootloader/products/lift.rs\""), "{}", same.args()[1]);
        assert!(Product::chosen("default").unwrap().is_default());
    }

    #[test]
    fn what_is_no_product_is_said() {
        for (word, why) in [
            ("loft", "has no loft.rs"),
            ("../src/product", "there is no product"),
            ("", "there is no product"),
            ("nowhere/lift.rs", "nowhere/lift.rs: "),
        ] {
            let refusal = Product::chosen(word).unwrap_err();
            assert!(refusal.contains(why), "{refusal}");
        }
        // It would have the name of the customer's, or one that a file of an image cannot have.
        let root = workspace::root();
        for file in ["bootloader/products/default.rs", "bootloader/src/flash_controller.rs"] {
            assert!(Product::of_file(&root.join(file)).unwrap_err().contains("the name of a product"));
        }
    }
}
