//! Tests of the rules for a scanner's EEPROM: which code may name or encode a request that writes the EEPROM, and which
//! code may give consent to this request.

use super::{assert_rule, crates, sources};

#[test]
fn eeprom_writer_only_computes() {
    assert_rule(crates::eeprom_writer_only_computes, |tree| {
        let (manifest, lib) = ("hub/lms-configure/Cargo.toml", "hub/lms-configure/src/lib.rs");
        vec![
            tree.with_line(manifest, "[dependencies]", "scanhub-port.workspace = true"),
            tree.with(lib, &tree.text(lib).replace("#![forbid(unsafe_code)]", "")),
            tree.with("hub/lms-configure/src/planted.rs", "//! A file.\nuse std::fs;\n"),
        ]
    });
}

#[test]
fn few_crates_can_write_the_eeprom() {
    assert_rule(crates::few_crates_can_write_the_eeprom, |tree| {
        let line = "scanhub-lms-configure.workspace = true";
        ["hub/port/Cargo.toml", "hub/drivers/Cargo.toml", "clients/client/Cargo.toml", "Cargo.toml"]
            .map(|manifest| tree.with_line(manifest, "[dependencies]", line))
            .to_vec()
    });
}

#[test]
fn only_configure_may_write_the_eeprom() {
    assert_rule(sources::only_configure_may_write_the_eeprom, |tree| {
        vec![
            tree.with(
                "hub/daemon/src/planted.rs",
                "//! Writes.\nlet telegram = Writer::new(0, 0x77).finish();\n",
            ),
            tree.with("hub/drivers/src/lms/planted.rs", "//! Knows.\npub const CONFIGURE: u8 = 0x77;\n"),
            tree.with("hub/drivers/src/lms.rs", "//! Knows.\npub const CONFIGURE: u8 = 0x77;\n"),
            tree.with(
                "hub/drivers/src/lms/planted.rs",
                "//! Writes.\nlet telegram = Writer::new(address, 0x66);\n",
            ),
            tree.with("hub/drivers/src/lms/explain.rs", "//! Writes.\nlet telegram = Writer::new(0, SET);\n"),
            tree.with(
                "hub/drivers/src/lms/protocol_state.rs",
                "//! Talks.\nuse crate::eeprom::EepromWrite;\n",
            ),
            tree.with("hub/drivers/src/lms/session.rs", "//! Talks.\nuse crate::{Nanos, eeprom};\n"),
            tree.with(
                "hub/drivers/src/lms/request_channel.rs",
                "//! Sends.\nlet request = crate::eeprom::EepromWrite::Field(&[]);\n",
            ),
            tree.with("hub/daemon/src/link.rs", "//! A link.\nuse scanhub_lms_configure::Change;\n"),
            tree.with("hub/tools/src/probe.rs", "//! Probes.\nuse scanhub_lms_configure::{eeprom, Plan};\n"),
            tree.with(
                "clients/verbs/src/planted.rs",
                "//! Knows.\nuse scanhub_lms_configure::eeprom::EepromWrite;\n",
            ),
        ]
    });
}

#[test]
fn only_a_person_confirms_eeprom_writes() {
    assert_rule(sources::only_a_person_confirms_eeprom_writes, |tree| {
        let planted = "//! Writes.\nlet consent = Consent::confirmed_by_person(plan);\n";
        let ask = tree.text("hub/tools/src/configure.rs");
        let plan = tree.text("hub/lms-configure/src/plan.rs");
        vec![
            tree.with("hub/daemon/src/link.rs", planted),
            tree.with("hub/tools/src/probe.rs", planted),
            tree.with("hub/cli/planted.rs", planted),
            tree.with(
                "hub/tools/src/configure.rs",
                &ask.replace("fn request_consent", &format!("{planted}fn request_consent")),
            ),
            tree.with(
                "hub/lms-configure/src/plan.rs",
                &plan.replace("Consent(plan)", "Consent(plan); Consent(plan)\n Consent(plan)"),
            ),
        ]
    });
}
