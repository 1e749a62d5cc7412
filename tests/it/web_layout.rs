//! Tests of the page's layout: in every demo and at every width, no box overlaps another box, and no text is cut off.

use std::process::Command;

use serde_json::Value;

use crate::browser::{Appearance, Browser};
use crate::recorded_world::recorded_world;
use crate::testkit::{INT, Program, TestEnv, wait_until};
use crate::web::web;
use crate::web_page::browse;
use scanhub_sim::world::World;

/// Window sizes (width and height) of a phone, a small laptop and a large laptop.
const WINDOW_SIZES: [(u32, u32); 3] = [(390, 844), (1024, 768), (1440, 900)];

/// Script that returns each pair of boxes that overlap, each box that is partly outside of the window, and each text
/// that is cut off.
const BREACHES_SCRIPT: &str = "(() => {
    const names = ['#verdict', '#people', '#swept', '#hub', '#news', '#readout', '#reason', '#layers', '#player', 'nav', 'article'];
    const boxes = names.flatMap((name) => [...document.querySelectorAll(name)].map((element) =>
        ({ name, element, box: element.getBoundingClientRect() }))).filter(({ box }) => box.width * box.height > 0);
    const breaches = [];
    boxes.forEach(({ name, element, box }, n) => {
        // The list of sensors scrolls.
        const isOutside = box.left < 0 || box.top < 0 || box.right > innerWidth + 0.5 || box.bottom > innerHeight + 0.5;
        if (name !== 'article' && isOutside) breaches.push(`${name} is outside`);
        if (element.scrollWidth > element.clientWidth + 1) breaches.push(`${name} is cut: ${element.innerText}`);
        for (const other of boxes.slice(n + 1)) {
            const [right, bottom] = ['right', 'bottom'].map((side) => Math.min(box[side], other.box[side]));
            const [left, top] = ['left', 'top'].map((side) => Math.max(box[side], other.box[side]));
            if (right - left > 0.5 && bottom - top > 0.5) breaches.push(`${name} is over ${other.name}`);
        }
    });
    return breaches;
})()";

/// Starts a demo, and returns the demo and the address of its page.
fn demo(world: &str, home: &str) -> (Program, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_scanhub"));
    command.args(["demo", "--world", world]).env_clear().env("XDG_STATE_HOME", home);
    let mut demo = Program::start(command);
    loop {
        if let Some((_, url)) = demo.next_text().split_once("browser: ") {
            break (demo, url.trim().to_owned());
        }
    }
}

/// Asserts that the layout is right, both with and without the list of layers.
fn check(page: &mut Browser, description: &str) {
    for layers in ["", ", with layers"] {
        // A busy browser drops movements of the mouse, so move the mouse until the page reacts.
        let mut x = (0..).map(|step| 330.0 + f64::from(step % 2));
        wait_until("the read-out is shown", || {
            page.mouse("mouseMoved", (x.next().expect("an endless sequence"), 330.0), false);
            page.ask("document.querySelector('#readout').innerText !== ''") == true
        });
        // The page shows the report of missed messages only for a short time, so set the text of the report here.
        let report = "62 messages missed: the server was too late, its machine may be busy";
        let script = format!("(document.querySelector('#news').textContent = '{report}', {BREACHES_SCRIPT})");
        assert_eq!(page.ask(&script), Value::Array(Vec::new()), "{description}{layers}");
        page.press("l");
    }
}

/// Checks the page at all sizes, in light and dark colors.
fn check_sizes(page: &mut Browser, description: &str) {
    for (width, height) in WINDOW_SIZES {
        for scheme in ["light", "dark"] {
            page.set_appearance(Appearance { width, height, scheme, is_phone: width == 390 });
            page.await_true(&format!("innerWidth === {width}"));
            check(page, &format!("{description}, {width} px, {scheme}"));
        }
    }
}

#[test]
fn boxes_do_not_overlap_in_any_demo() {
    for (world, condition, chip) in [
        ("demo", "scanhub.sensors.length === 2 && scanhub.zones === 2", "#verdict"),
        ("house", "scanhub.sensors.length === 4 && scanhub.tracks > 0", "#people"),
        ("tilt", "scanhub.sweeps[0]?.words !== undefined", "#swept"),
    ] {
        let env = TestEnv::new();
        let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
        let (demo, url) = demo(world, &env.path_argument("home"));
        page.open(&url);
        page.await_true(&format!("window.scanhub?.beams > 0 && {condition}"));
        page.await_true(&format!("document.querySelector('{chip}').innerText !== ''"));
        check_sizes(&mut page, world);
        if world == "tilt" {
            page.press("h");
            page.await_true("scanhub.aside && scanhub.swept > 0");
            check_sizes(&mut page, "tilt from the side");
        }
        assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
        assert_eq!(demo.end(INT).exit_code, Some(0));
    }
}

#[test]
fn boxes_do_not_overlap_without_a_hub() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    page.await_true("window.scanhub?.connected && /no hub/.test(scanhub.reason)");
    check_sizes(&mut page, "without a hub");
}

#[test]
fn boxes_do_not_overlap_while_a_recording_plays() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let world: World = "demo".parse().expect("a world");
    let file = recorded_world(&env, &world, &["front", "rear"], 60);
    let (_server, host) = web(&env, &["--replay", &file, "--loop"]);
    page.open(&format!("http://{host}/"));
    page.await_true(
        "window.scanhub?.player && scanhub.beams > 0 && !document.querySelector('#player').hidden",
    );
    check_sizes(&mut page, "recording");
}
