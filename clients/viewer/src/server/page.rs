//! Web page: markup, style and script in one response, and the policy that lets a browser run only this script. Style
//! and script are sent without comments and indentation.

use data_encoding::BASE64;
use sha2::{Digest, Sha256};

const MARKUP: &str = include_str!("../../page/page.html");
const STYLE: &str = include_str!("../../page/page.css");
/// Files of the script, in the order in which the browser reads them.
const SCRIPT: &str = concat!(
    include_str!("../../page/scene.js"),
    include_str!("../../page/wire.js"),
    include_str!("../../page/view.js"),
    include_str!("../../page/draw.js"),
    include_str!("../../page/overlays.js"),
    include_str!("../../page/side_view.js"),
    include_str!("../../page/frame.js"),
    include_str!("../../page/labels.js"),
    include_str!("../../page/input.js"),
);

/// The page and its policy.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) body: String,
    hashes: [String; 2],
}

impl Page {
    pub(crate) fn new() -> Page {
        let hash = |text: &str| BASE64.encode(&Sha256::digest(text));
        let (script, style) = (compact(SCRIPT), compact(STYLE));
        let body = MARKUP.replace("/* page.css */", &style).replace("/* page.js */", &script);
        Page { body, hashes: [hash(&script), hash(&style)] }
    }

    /// Returns the content security policy of the page for `host`. The policy contains the WebSocket's address, because
    /// in some browsers 'self' does not include it.
    pub(crate) fn policy(&self, host: &str) -> String {
        let [script, style] = &self.hashes;
        format!(
            "default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; img-src data:; \
             connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
    }
}

/// Returns `text` without indentation, empty lines, and comments that start a line.
fn compact(text: &str) -> String {
    let (mut compact, mut is_comment) = (String::with_capacity(text.len()), false);
    for line in text.lines().map(str::trim_start) {
        is_comment |= line.starts_with("/*");
        if !is_comment && !line.is_empty() && !line.starts_with("//") {
            compact.push_str(line);
            compact.push('\n');
        }
        is_comment &= !line.ends_with("*/");
    }
    compact
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_is_one_small_response_without_external_parts() {
        let page = Page::new();
        assert!(page.body.len() < 64_000, "{} bytes", page.body.len());
        assert!(page.body.contains(&compact(STYLE)) && page.body.contains(&compact(SCRIPT)));
        assert!(!page.body.contains("https://") && !page.body.contains("src="), "nothing is loaded");
        assert!(!SCRIPT.contains("</script") && !STYLE.contains("</style"));
        assert!(!SCRIPT.contains("innerHTML"), "names from elsewhere stay text");
    }

    #[test]
    fn comments_and_indentation_are_not_sent() {
        let text = "/** Two\n * lines. */\nif (a) {\n  // No.\n\n  b(\"//c\"); // Yes.\n}\n/* One. */\nd\n";
        assert_eq!(compact(text), "if (a) {\nb(\"//c\"); // Yes.\n}\nd\n");
    }

    /// Returns the color `name` of the light and of the dark page, as 8-bit red, green and blue.
    fn color(name: &str) -> [[u8; 3]; 2] {
        let line = STYLE.lines().find_map(|line| line.trim().strip_prefix(&format!("--{name}: light-dark(")));
        let both = line.and_then(|line| line.strip_suffix(");")).unwrap_or_else(|| panic!("no {name}"));
        let parts: Vec<_> = both.split(", ").map(|part| part.strip_prefix('#').unwrap()).collect();
        let channel = |part: &str, at: usize| u8::from_str_radix(&part[2 * at..2 * at + 2], 16).unwrap();
        [0, 1].map(|scheme| [0, 1, 2].map(|at| channel(parts[scheme], at)))
    }

    /// Returns the contrast of two colors by WCAG 2.2 (relative luminance of sRGB), 1 to 21.
    fn contrast(a: [u8; 3], b: [u8; 3]) -> f64 {
        let linear = |channel: u8| {
            let value = f64::from(channel) / 255.0;
            if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
        };
        let luminance =
            |[r, g, b]: [u8; 3]| 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b) + 0.05;
        let (a, b) = (luminance(a), luminance(b));
        a.max(b) / a.min(b)
    }

    /// WCAG 2.2, 1.4.3 and 1.4.11: text needs a contrast of 4.5 to 1, and figures with a meaning need 3 to 1, on the
    /// light and the dark page.
    #[test]
    fn colors_have_the_contrast_that_wcag_requires() {
        assert!((contrast([0; 3], [255; 3]) - 21.0).abs() < 1e-9);
        let check_contrast = |inks: &[&str], papers: &[&str], wanted: f64| {
            for (ink, paper) in inks.iter().flat_map(|ink| papers.iter().map(move |paper| (ink, paper))) {
                for scheme in [0, 1] {
                    let ratio = contrast(color(ink)[scheme], color(paper)[scheme]);
                    assert!(ratio >= wanted, "{ink} on {paper}, scheme {scheme}: {ratio:.2} of {wanted}");
                }
            }
        };
        check_contrast(&["ink", "soft", "accent", "slow", "stop", "clear"], &["paper", "panel"], 4.5);
        check_contrast(&["new", "mark", "line", "soft", "stop"], &["paper"], 3.0);
        check_contrast(&["person"], &["paper", "panel"], 4.5);
        for fill in ["clear-fill", "slow-fill", "stop-fill"] {
            for scheme in [0, 1] {
                let ratio = contrast([255; 3], color(fill)[scheme]);
                assert!(ratio >= 4.5, "white on {fill}, scheme {scheme}: {ratio:.2}");
            }
        }
    }
}
