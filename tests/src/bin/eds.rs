//! Writes the EDS files to a folder, of the product of the build if it is not the default one: `cargo xtask
//! eds`.

use std::path::Path;
use std::process::ExitCode;
use std::{env, fs};

use coboot_tests::eds;

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [folder] = &arguments[..] else {
        eprintln!("usage: eds FOLDER");
        return ExitCode::from(2);
    };
    if let Err(error) = fs::create_dir_all(folder) {
        eprintln!("{folder}: {error}");
        return ExitCode::FAILURE;
    }
    for image in eds::chosen().unwrap_or_else(eds::images) {
        let path = Path::new(folder).join(&image.file);
        if let Err(error) = fs::write(&path, image.eds()) {
            eprintln!("{}: {error}", path.display());
            return ExitCode::FAILURE;
        }
        println!("{}: {} objects", path.display(), image.indices().len());
    }
    ExitCode::SUCCESS
}
