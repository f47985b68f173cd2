//! Tests of `coflash ui` in a real Chromium, which tests/python/ui_page.py controls: with nodes
//! (`coboot-node`) that the script starts, and with the emulated board.

#[cfg(reference_board)]
mod machine;

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use canopen::Address;
use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use kit::folder::Folder;

/// A program that `cargo xtask test` has built or installed.
fn given(name: &str) -> PathBuf {
    let path =
        env::var_os(name).unwrap_or_else(|| panic!("{name} is not set: run the tests by `cargo xtask test`"));
    path.into()
}

/// The script with the arguments of every scenario, and a folder for its files.
fn script(scenario: &str) -> (Command, Folder) {
    let folder = kit::folder!(&format!("ui-{scenario}"));
    let mut command = Command::new(given("COBOOT_PYTHON"));
    command
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("python/ui_page.py"))
        .arg(scenario)
        .arg("--coflash")
        .arg(given("COBOOT_COFLASH"))
        .arg("--folder")
        .arg(&*folder);
    // The pictures of the documentation are taken here, if they are requested.
    if let Some(pictures) = env::var_os("COBOOT_PICTURES") {
        command.arg("--pictures").arg(pictures);
    }
    for variable in ["COFLASH_BUS", "COFLASH_CONFIG"] {
        command.env_remove(variable);
    }
    // A service station remembers its adapter there.
    command.env("XDG_STATE_HOME", &*folder);
    (command, folder)
}

#[track_caller]
fn check(scenario: &str, output: &Output) {
    let said = [&output.stdout[..], &output.stderr[..]].concat();
    let said = String::from_utf8_lossy(&said);
    assert!(output.status.success() && said.contains(&format!("{scenario}: done")), "{said}");
}

/// Runs a scenario with nodes of its own.
#[track_caller]
fn with_nodes(scenario: &str) {
    let (mut command, _folder) = script(scenario);
    let output = command.arg("--node").arg(given("COBOOT_NODE")).output().unwrap();
    check(scenario, &output);
}

#[test]
fn two_nodes_are_updated_by_dropping_a_file() {
    with_nodes("two_nodes");
}

#[test]
fn an_adapter_that_goes_away_in_mid_update_is_told_and_comes_back() {
    with_nodes("unplugged");
}

#[test]
fn what_is_for_another_product_or_no_firmware_is_refused() {
    with_nodes("refused");
}

#[test]
fn a_reload_a_second_tab_and_a_closed_tab_do_no_harm_in_mid_update() {
    with_nodes("reload_in_mid_update");
}

#[test]
fn a_reload_keeps_the_chosen_devices_the_file_and_the_options() {
    with_nodes("reload_keeps_the_choice");
}

#[test]
fn single_steps_and_lss_by_keys_alone() {
    with_nodes("single_steps");
}

#[test]
fn the_page_is_readable_wide_and_narrow_in_light_and_dark() {
    with_nodes("looks");
}

#[test]
fn a_service_station_updates_a_machine_by_keys_and_barcodes_and_remembers_its_adapter() {
    with_nodes("service");
}

#[test]
fn a_service_station_keeps_what_it_cannot_save() {
    with_nodes("service_full");
}

#[test]
fn a_service_station_offers_the_adapter_and_the_bit_rate_of_the_last_time() {
    with_nodes("service_adapters");
}

#[test]
fn a_service_station_is_readable_in_both_languages() {
    with_nodes("service_looks");
}

#[test]
fn the_emulated_board_is_updated_by_dropping_an_elf() {
    let bench = Bench::new().switched_on();
    let mut endpoint = Endpoint::new(bench);
    let (mut command, _folder) = script("emulated");
    command.args(["--bus", &endpoint.url(), "--image"]).arg(firmware::dir().join(firmware::APP_V1));
    let output = endpoint.run(&mut command);
    check("emulated", &output);
    assert_eq!(endpoint.bench.session().read_text(Address::new(0x100A, 0)).unwrap(), "1.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}
