//! Makes the package for Debian and Ubuntu with cargo-deb; `[package.metadata.deb]` in
//! coflash/cli/Cargo.toml says what is in it.

use std::process::Command;

use super::build;
use super::release::{Release, LINUX, VERSION};
use crate::{files, outcome::Outcome, process, setup, workspace};

/// The version of cargo-deb that the job installs.
const CARGO_DEB: &str = "3.8.0";

pub fn make(release: &Release) -> Outcome {
    setup::prepare(&[setup::Part::Deb])?;
    let cargo_deb = setup::tool("cargo-deb", CARGO_DEB, &[])?;
    // Beside the program, where the metadata names them.
    let parts = release.build.join(LINUX).join(build::PROFILE).join("deb");
    files::remove(&parts)?;
    build::with_extras(release, &parts)?;
    // Debian requires a changelog, with the date in the form of a mail.
    let mut date = Command::new("date");
    date.args(["--utc", "--rfc-email", "--date", &format!("@{}", release.epoch)]);
    let changelog = format!(
        "coflash ({VERSION}) unstable; urgency=medium\n\n  * CHANGELOG.md in the sources says what changed.\n\n \
         -- coboot <coboot@example.invalid>  {}",
        process::output(&mut date)?
    );
    files::write(&parts.join("changelog"), changelog)?;
    let pages = files::within(&parts.join("man"))?;
    process::run(Command::new("gzip").args(["-9", "--no-name"]).arg(parts.join("changelog")).args(pages))?;
    let mut deb = Command::new(cargo_deb);
    deb.arg("--manifest-path").arg(workspace::root().join("coflash/cli/Cargo.toml"));
    deb.args(["--locked", "--no-build", "--no-strip", "--profile", build::PROFILE, "--target", LINUX]);
    deb.args(["--deb-version", VERSION, "--output"]).arg(release.deb());
    deb.env("CARGO_TARGET_DIR", &release.build).env("SOURCE_DATE_EPOCH", &release.epoch);
    process::run(deb.current_dir(workspace::root()))
}
