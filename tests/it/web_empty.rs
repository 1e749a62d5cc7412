//! Tests of pages without data: the page shows the reason and the remedy, and colors show how serious the reason is.

use serde_json::Value;

use crate::browser::{Appearance, Browser};
use crate::foreign_user::{OTHER_UID, run_as_other_user, scanhub, with_another_user};
use crate::testkit::{INT, Program, TestEnv, in_a_network, is_class};
use crate::web::web;
use crate::web_page::browse;

/// Returns the value of the color that the style of the page calls `name`.
fn color(page: &mut Browser, name: &str) -> Value {
    page.ask(&format!(
        "(() => {{ const probe = document.createElement('i'); document.body.append(probe); \
         probe.style.color = 'var(--{name})'; const computed = getComputedStyle(probe).color; probe.remove(); return computed; }})()"
    ))
}

/// Waits until the page shows a reason that contains `description`, and a remedy that contains `remedy`.
fn wait_for_reason(page: &mut Browser, description: &str, remedy: &str) {
    let reason = "document.querySelector('#reason')";
    let has_text =
        |part: &str, words: &str| format!("{reason}.{part}ElementChild.innerText.includes({words:?})");
    let (what, remedy) = (has_text("first", description), has_text("last", remedy));
    page.await_true(&format!("Boolean(window.scanhub) && !{reason}.hidden && {what} && {remedy}"));
    assert_eq!(page.ask("scanhub.verdict"), "unknown");
    let color_now = page.ask("getComputedStyle(document.querySelector('#verdict strong')).backgroundColor");
    assert_eq!(color_now, color(page, "stop-fill"), "an unknown verdict must have the color of a stop");
}

#[test]
fn page_gives_a_reason_for_a_missing_hub_or_port() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    wait_for_reason(&mut page, "no hub in domain", "start one with `scanhub run`");
    let _hub = env.hub(&[env.link("front")]);
    wait_for_reason(&mut page, "front: ", "plug its adapter in, or name the right port");
    let sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    page.await_true("scanhub.reason === null && scanhub.beams > 100");
    env.kill_port_simulator(sensor, "front");
    wait_for_reason(&mut page, "front: ", "plug its adapter in, or name the right port");
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

#[test]
fn page_reports_missing_remote_sensors() {
    in_a_network("web_empty::page_reports_missing_remote_sensors", || {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
        let listener = env.start(&["listen", "--json", "--publish"]).ready();
        let (_server, host) = web(&env, &[]);
        page.open(&format!("http://{host}/"));
        wait_for_reason(&mut page, "no remote sensor is published here yet", "scanhub gateway");
        assert_eq!(listener.end(INT).exit_code, Some(0));
    });
}

#[test]
fn hub_of_another_user_is_named() {
    with_another_user("web_empty::hub_of_another_user_is_named", || {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
        run_as_other_user("mkdir -m 755 /tmp/theirs");
        let arguments = ["run", "--json", "--no-system-config", "--link=front=/tmp/no", "--root=/tmp/theirs"];
        let _hub = Program::start(scanhub(OTHER_UID, &arguments)).ready();
        let arguments = ["web", "--json", "--listen=127.0.0.1:0", "--root=/tmp/theirs"];
        let mut server = Program::start(scanhub(0, &arguments));
        let ready = server.await_line("the address of the page", is_class("ready"));
        page.open(ready["url"].as_str().expect("an address"));
        wait_for_reason(&mut page, "belongs to user 65533", "listen --publish");
        assert_eq!(server.end(INT).exit_code, Some(0));
    });
}

#[test]
fn lossy_sensor_is_amber_with_its_loss_rate() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let faults = ["--seed=71", "--baud=500000", "--fault=loss=0.00135,burst=1.89"];
    let _sensor = env.simulator(&["front"], &faults);
    let _hub = env.hub(&[env.link("front")]);
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    let card = "document.querySelector('#sensors article.streaming.lossy')";
    page.await_true(&format!(
        "/^[1-9][0-9.]* % of its simulated line is damaged or lost: simulated faults/\
         .test({card}?.querySelector('.problem').innerText)"
    ));
    let amber = color(&mut page, "slow");
    // On a busy machine, the card of a sensor can change its state at any time. Therefore compare with the dot on the
    // card, which also shows the state.
    page.await_true(&format!(
        "(card => {{\n\
            const color = (selector, pseudo) => getComputedStyle(card.querySelector(selector), pseudo);\n\
            return card !== null && color('.problem').color === {amber} && color('.amber dd').color === {amber}\n\
                && color('h2 i', '::before').backgroundColor === {amber};\n\
        }})({card})"
    ));
    assert_ne!(amber, color(&mut page, "clear"));
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}
