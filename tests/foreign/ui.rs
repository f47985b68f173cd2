//! Tests of `coflash ui` in a real Chromium, which tests/python/ui_page.py controls: with nodes
//! (`coboot-node`) that the script starts, and with the emulated board.

#[cfg(reference_board)]
mod machine;

use std::env;
use std::process::{Command, Output};

use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::tools::{self, given};
use kit::folder::Folder;

/// The script with the arguments of every scenario, and a folder for its files.
fn script(scenario: &str) -> (Command, Folder) {
    let folder = kit::folder!(&format!("ui-{scenario}"));
    let mut command = tools::script("ui_page.py");
    command.arg(scenario).arg("--coflash").arg(given("COBOOT_COFLASH")).arg("--folder").arg(&*folder);
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
    let said = tools::text(output);
    assert!(output.status.success() && said.contains(&format!("{scenario}: done")), "{said}");
}

/// The scenarios with nodes of their own, each with a test.
macro_rules! scenarios {
    ($($name:ident $scenario:literal)*) => {
        $(
            #[test]
            fn $name() {
                let (mut command, _folder) = script($scenario);
                let output = command.arg("--node").arg(given("COBOOT_NODE")).output().unwrap();
                check($scenario, &output);
            }
        )*
    };
}

scenarios! {
    two_nodes_are_updated_by_dropping_a_file "two_nodes"
    an_adapter_that_goes_away_in_mid_update_is_told_and_comes_back "unplugged"
    what_is_for_another_product_or_no_firmware_is_refused "refused"
    a_reload_a_second_tab_and_a_closed_tab_do_no_harm_in_mid_update "reload_in_mid_update"
    a_reload_keeps_the_chosen_devices_the_file_and_the_options "reload_keeps_the_choice"
    single_steps_and_lss_by_keys_alone "single_steps"
    the_page_is_readable_wide_and_narrow_in_light_and_dark "looks"
    a_service_station_updates_a_machine_by_keys_and_barcodes_and_remembers_its_adapter "service"
    a_service_station_keeps_what_it_cannot_save "service_full"
    many_pages_leave_a_connection_and_the_browser_gets_no_token "service_tabs"
    a_service_station_offers_the_adapter_and_the_bit_rate_of_the_last_time "service_adapters"
    a_service_station_is_readable_in_both_languages "service_looks"
}

#[test]
fn the_emulated_board_is_updated_by_dropping_an_elf() {
    let bench = Bench::new().switched_on();
    let mut endpoint = Endpoint::new(bench);
    let (mut command, _folder) = script("emulated");
    command.args(["--bus", &endpoint.url(), "--image"]).arg(firmware::dir().join(firmware::APP_V1));
    let output = endpoint.run(&mut command);
    check("emulated", &output);
    assert_eq!(endpoint.bench.text(0x100A), "1.0.0");
    endpoint.bench.assert_nothing_unmodelled();
}
