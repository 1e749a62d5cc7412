//! The page: its markup, its style and its script in one answer, and the policy by which a browser runs this script and no
//! other.

use data_encoding::BASE64;
use sha2::{Digest, Sha256};

const MARKUP: &str = include_str!("../page/page.html");
const STYLE: &str = include_str!("../page/page.css");
const SCRIPT: &str = include_str!("../page/page.js");

/// The page and its policy.
#[derive(Debug)]
pub(crate) struct Page {
    pub(crate) body: String,
    hashes: [String; 2],
}

impl Page {
    pub(crate) fn new() -> Page {
        let hash = |text: &str| BASE64.encode(&Sha256::digest(text));
        let body = MARKUP.replace("/* page.css */", STYLE).replace("/* page.js */", SCRIPT);
        Page { body, hashes: [hash(SCRIPT), hash(STYLE)] }
    }

    /// The policy of the page as `host`: an address of a WebSocket is not every browser's 'self'.
    pub(crate) fn policy(&self, host: &str) -> String {
        let [script, style] = &self.hashes;
        format!(
            "default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; img-src data:; \
             connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_one_small_answer_without_anybody_elses_parts() {
        let page = Page::new();
        assert!(page.body.len() < 60_000, "{} bytes", page.body.len());
        assert!(page.body.contains(STYLE) && page.body.contains(SCRIPT));
        assert!(!page.body.contains("https://") && !page.body.contains("src="), "nothing is loaded");
        assert!(!SCRIPT.contains("</script") && !STYLE.contains("</style"));
        assert!(!SCRIPT.contains("innerHTML"), "names from elsewhere stay text");
    }
}
