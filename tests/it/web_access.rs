//! Tests of the web page for users who cannot use a mouse, use a screen reader, or prefer reduced motion. A test next
//! to the colors, in `clients/viewer/src/server/page.rs`, checks contrasts.

use serde_json::{Value, json};

use crate::browser::{Appearance, Browser};
use crate::testkit::{TestEnv, wait_until};
use crate::web::web;
use crate::web_page::browse;

/// Opens the page of a hub with two sensors.
fn open_page(env: &TestEnv, appearance: Appearance) -> Option<(Browser, Vec<crate::testkit::Program>)> {
    let mut page = browse(env, appearance)?;
    let sensors = env.simulator(&["front", "rear"], &["--seed=5", "--baud=500000", "--world=demo"]);
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    let (server, host) = web(env, &[]);
    page.open(&format!("http://{host}/"));
    page.await_true("window.scanhub?.beams > 600 && scanhub.verdict !== 'unknown'");
    page.await_true("document.querySelectorAll('#sensors article.streaming').length === 2");
    Some((page, vec![sensors, hub, server]))
}

/// Script that returns the name of the element with the keyboard focus.
const FOCUSED_ELEMENT: &str = "(document.activeElement === document.body ? 'BODY' : document.activeElement.getAttribute('aria-label') || document.activeElement.innerText || \
                      document.activeElement.tagName).trim()";

#[test]
fn page_is_usable_with_the_keyboard_alone() {
    let env = TestEnv::new();
    let Some((mut page, _programs)) = open_page(&env, Appearance::LAPTOP) else { return };
    // Tab must reach every element that can be pressed, and each element must show that it has the focus.
    let mut reached: Vec<String> = Vec::new();
    for _ in 0..40 {
        page.press("Tab");
        let holder = page.ask(FOCUSED_ELEMENT).as_str().unwrap_or_default().to_owned();
        if reached.first() == Some(&holder) {
            break;
        }
        let outline = "getComputedStyle(document.activeElement).outlineStyle";
        assert!(
            holder == "BODY" || page.ask(outline) != "none",
            "{holder} does not show that it has the focus"
        );
        reached.push(holder);
    }
    let all = "[...document.querySelectorAll('button, canvas[tabindex]')].filter((one) => one.offsetParent || one.id === 'map')\
               .map((one) => (one.getAttribute('aria-label') || one.innerText).trim())";
    let all = page.ask(all);
    for name in all.as_array().expect("names").iter().filter_map(Value::as_str) {
        assert!(reached.iter().any(|holder| holder == name), "{name} of {reached:?}");
    }
    assert!(all.as_array().is_some_and(|all| all.len() >= 11), "{all}");

    // Enter and the space bar press the focused element.
    let pressed = |description: &str| {
        format!("document.querySelector('{description}').getAttribute('aria-pressed') === 'true'")
    };
    page.ask("document.querySelector('[data-do=hold]').focus()");
    page.press("Enter");
    page.await_true(&pressed("[data-do=hold]"));
    page.press(" ");
    page.await_true(&format!("!({})", pressed("[data-do=hold]")));
    page.ask("document.querySelector('#sensors button').focus()");
    page.press("Enter");
    page.await_true(&pressed("#sensors button"));
    page.press("0");
    page.await_true(&format!("!({})", pressed("#sensors button")));
    // Keys move the view, as a mouse or touch does. The first of these keys stops the automatic fit.
    page.press("ArrowUp");
    page.await_true(&format!("!({})", pressed("[data-do=fit]")));
    let moves =
        [("ArrowUp", "x"), ("ArrowLeft", "y"), ("+", "scale"), ("-", "scale"), ("[", "turn"), ("]", "turn")];
    for (key, part) in moves {
        let before = page.ask(&format!("scanhub.view.{part}"));
        page.press(key);
        page.await_true(&format!("scanhub.view.{part} !== {before}"));
    }
    page.press("2");
    page.await_true(&pressed("#sensors article:nth-child(2) button"));
    page.press("0");
    page.press("c");
    page.await_true(&pressed("[data-do=fit]"));
    page.press("l");
    page.await_true("document.querySelector('#layers').classList.contains('open')");
    let keys = "[...document.querySelectorAll('#layers kbd')].map((one) => one.innerText).join(' ')";
    assert_eq!(page.ask(keys), "s i f t b z m e o v g");
    page.await_true("document.querySelector('#scale').innerText.startsWith('0') && !document.querySelector('#scale').hidden");
    page.await_true("[...document.querySelectorAll('#layers button')].every((one) => one.ariaLabel && one.offsetHeight > 0)");
    // A dialog takes the focus, and gives it back when it is closed.
    page.ask("document.querySelector('[data-do=layers]').focus()");
    page.press("?");
    page.await_true("document.querySelector('#help').contains(document.activeElement)");
    page.press("Escape");
    page.await_true("document.activeElement.dataset.do === 'layers'");
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

/// Returns the role and the name of each node that a screen reader finds on the page.
fn tree(page: &mut Browser) -> Vec<(String, String)> {
    let tree = page.call("Accessibility.getFullAXTree", json!({}));
    let nodes = tree["nodes"].as_array().expect("nodes").iter().filter(|node| node["ignored"] != true);
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    nodes.map(|node| (text(&node["role"]["value"]), text(&node["name"]["value"]))).collect()
}

/// Returns the names of the nodes with `role`.
fn nodes_with_role<'a>(nodes: &'a [(String, String)], role: &str) -> Vec<&'a str> {
    nodes.iter().filter(|node| node.0 == role).map(|node| node.1.as_str()).collect()
}

#[test]
fn screen_readers_get_names_states_and_the_verdict() {
    let env = TestEnv::new();
    let Some((mut page, _programs)) = open_page(&env, Appearance::LAPTOP) else { return };
    let words = ["SLOW", "CLEAR", "STOP"];
    // On a busy machine, the verdict may be unknown for a short time, and a sensor may have no status.
    let mut nodes = Vec::new();
    wait_until("the tree has a verdict and a sensor that streams", || {
        nodes = tree(&mut page);
        let texts = nodes_with_role(&nodes, "StaticText");
        texts.contains(&"streaming") && words.iter().any(|word| texts.contains(word))
    });
    let named = |role| nodes_with_role(&nodes, role);
    assert!(named("button").len() >= 11 && named("button").iter().all(|name| !name.is_empty()), "{nodes:?}");
    assert!(named("image").iter().any(|name| name.contains("from above")), "{:?}", named("image"));
    assert!(
        named("complementary").contains(&"Sensors") && named("navigation").contains(&"Picture"),
        "{nodes:?}"
    );
    for word in ["rate", "age p50 / p99", "damaged on the line"] {
        assert!(named("StaticText").contains(&word), "{word} of {:?}", named("StaticText"));
    }
    let live = "document.querySelector('#verdict').getAttribute('aria-live')";
    assert_eq!(page.ask(live), "assertive");
    assert_eq!(page.ask("document.documentElement.lang"), "en");
}

#[test]
fn reduced_motion_disables_animations() {
    let env = TestEnv::new();
    let Some((mut page, _programs)) = open_page(&env, Appearance::LAPTOP) else { return };
    // Script that observes the view while it moves back from a larger scale. The script returns the number of different
    // scales that it has seen. It ends when the scale has not changed for 20 frames.
    let places = "new Promise((done) => {
        const scales = new Set();
        let [last, still] = [0, 0];
        const look = () => {
            const { scale } = scanhub.view;
            scales.add(scale);
            still = scale === last ? still + 1 : 0;
            last = scale;
            if (still < 20) requestAnimationFrame(look); else done(scales.size);
        };
        requestAnimationFrame(look);
    })";
    let count = |page: &mut Browser, motion: &str| {
        let features = json!([{ "name": "prefers-reduced-motion", "value": motion }]);
        page.call("Emulation.setEmulatedMedia", json!({ "features": features }));
        for _ in 0..6 {
            page.press("+");
        }
        page.press("c");
        page.ask(places).as_u64().expect("a number")
    };
    let (glides, jumps) = (count(&mut page, "no-preference"), count(&mut page, "reduce"));
    assert!(glides >= 6 && jumps <= 4, "{glides} places, and {jumps} without movement");
}
