//! A page on which nothing is drawn says why and what to do, and what is worse than it looks is as red as it is.

use serde_json::Value;

use crate::browser::{Browser, Look};
use crate::strangers::{STRANGER, beside_a_stranger, scanhub, stranger};
use crate::testkit::{INT, Program, TestEnv, in_a_network, is_class};
use crate::web::web;
use crate::web_page::browse;

/// The colour that the page's style calls `name`.
fn colour(page: &mut Browser, name: &str) -> Value {
    page.ask(&format!(
        "(() => {{ const probe = document.createElement('i'); document.body.append(probe); \
         probe.style.color = 'var(--{name})'; const told = getComputedStyle(probe).color; probe.remove(); return told; }})()"
    ))
}

/// Waits until the page says `what`, and how it is mended in words that have `remedy`.
fn await_reason(page: &mut Browser, what: &str, remedy: &str) {
    let reason = "document.querySelector('#reason')";
    let says = |part: &str, words: &str| format!("{reason}.{part}ElementChild.innerText.includes({words:?})");
    let (what, remedy) = (says("first", what), says("last", remedy));
    page.await_true(&format!("Boolean(window.scanhub) && !{reason}.hidden && {what} && {remedy}"));
    assert_eq!(page.ask("scanhub.verdict"), "unknown");
    let seen = page.ask("getComputedStyle(document.querySelector('#verdict strong')).backgroundColor");
    assert_eq!(seen, colour(page, "stop-fill"), "what is not known is as red as a stop");
}

#[test]
fn a_sensor_that_is_silent_and_one_whose_port_is_gone() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Look::LAPTOP) else { return };
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    await_reason(&mut page, "no hub in domain", "start one with `scanhub run`");
    let _hub = env.hub(&[env.link("front")]);
    await_reason(&mut page, "front: ", "plug its adapter in, or name the right port");
    let sensor = env.simulator(&["front"], &["--seed=5", "--baud=500000"]);
    page.await_true("scanhub.reason === null && scanhub.beams > 100");
    env.kill_simulator(sensor, "front");
    await_reason(&mut page, "front: ", "plug its adapter in, or name the right port");
    assert!(page.complaints.is_empty(), "{:?}", page.complaints);
}

#[test]
fn where_only_other_machines_are_listened_to_that_is_said() {
    in_a_network("web_empty::where_only_other_machines_are_listened_to_that_is_said", || {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Look::LAPTOP) else { return };
        let listener = env.start(&["listen", "--json", "--publish"]).ready();
        let (_server, host) = web(&env, &[]);
        page.open(&format!("http://{host}/"));
        await_reason(&mut page, "no sensor of another machine is published here yet", "scanhub gateway");
        assert_eq!(listener.end(INT).code, Some(0));
    });
}

#[test]
fn the_hub_of_another_user_is_named() {
    beside_a_stranger("web_empty::the_hub_of_another_user_is_named", || {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Look::LAPTOP) else { return };
        stranger("mkdir -m 755 /tmp/theirs");
        let arguments = ["run", "--json", "--no-system-config", "--link=front=/tmp/no", "--root=/tmp/theirs"];
        let _hub = Program::start(scanhub(STRANGER, &arguments)).ready();
        let arguments = ["web", "--json", "--listen=127.0.0.1:0", "--root=/tmp/theirs"];
        let mut server = Program::start(scanhub(0, &arguments));
        let ready = server.await_line("its address", is_class("ready"));
        page.open(ready["url"].as_str().expect("an address"));
        await_reason(&mut page, "belongs to user 65533", "listen --publish");
        assert_eq!(server.end(INT).code, Some(0));
    });
}

#[test]
fn a_sensor_that_loses_on_its_line_is_amber_and_says_how_much() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Look::LAPTOP) else { return };
    let faults = ["--seed=71", "--baud=500000", "--fault=loss=0.00135,burst=1.89"];
    let _sensor = env.simulator(&["front"], &faults);
    let _hub = env.hub(&[env.link("front")]);
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    let card = "document.querySelector('#sensors article.streaming.lossy')";
    page.await_true(&format!(
        "/^[1-9][0-9.]* % of its simulated line is damaged or lost: simulated faults/\
         .test({card}?.querySelector('.trouble').innerText)"
    ));
    let amber = colour(&mut page, "slow");
    // On a busy machine, a card can change its state at any time. Its dot shows the state, too.
    page.await_true(&format!(
        "(card => {{\n\
            const color = (selector, pseudo) => getComputedStyle(card.querySelector(selector), pseudo);\n\
            return card !== null && color('.trouble').color === {amber} && color('.amber dd').color === {amber}\n\
                && color('h2 i', '::before').backgroundColor === {amber};\n\
        }})({card})"
    ));
    assert_ne!(amber, colour(&mut page, "clear"));
    assert!(page.complaints.is_empty(), "{:?}", page.complaints);
}
