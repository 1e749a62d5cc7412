//! Tables and examples of docs/output.md: the classes of JSON lines, and their keys.

use serde_json::Value;

/// Row of a table in `docs/output.md`: classes, the verbs that print them, and optional keys, which examples may lack.
pub(super) struct OutputRow<'a> {
    pub(super) classes: Vec<&'a str>,
    pub(super) verbs: Vec<&'a str>,
    pub(super) keys: Vec<&'a str>,
}

/// Line of JSON in `docs/output.md`.
pub(super) struct OutputExample<'a> {
    /// Heading above the line.
    heading: &'a str,
    pub(super) class: String,
    pub(super) keys: Vec<String>,
}

impl OutputExample<'_> {
    /// Returns whether this is an example of `row`. A heading such as `summary of tilt` restricts its examples to the
    /// rows of that verb.
    pub(super) fn is_of(&self, row: &OutputRow<'_>) -> bool {
        let is_of_verb = match self.heading.split_once(" of ") {
            Some((_, named)) => row.verbs.iter().any(|verb| {
                let first = verb.split_whitespace().next();
                named.split_whitespace().any(|word| Some(word) == first)
            }),
            None => true,
        };
        is_of_verb && row.classes.iter().any(|class| *class == self.class)
    }
}

/// Returns the rows of classes in the tables of `page`.
pub(super) fn rows(page: &str) -> Vec<OutputRow<'_>> {
    let mut rows = Vec::new();
    for row in page.lines().filter(|row| row.starts_with("| `")) {
        let mut cells = row.split(" | ");
        let [classes, verbs] = [(); 2].map(|()| quoted(cells.next().unwrap_or_default()));
        let keys = cells.flat_map(quoted).flat_map(str::split_whitespace).collect();
        rows.push(OutputRow { classes, verbs, keys });
    }
    rows
}

/// Returns the texts in backticks in `cell`.
fn quoted(cell: &str) -> Vec<&str> {
    cell.split('`').skip(1).step_by(2).collect()
}

/// Returns the lines of JSON on `page`.
pub(super) fn examples(page: &str) -> Vec<OutputExample<'_>> {
    let mut examples = Vec::new();
    let mut heading = "";
    for line in page.lines() {
        heading = line.strip_prefix("### ").unwrap_or(heading);
        if line.starts_with('{')
            && let Ok(Value::Object(object)) = serde_json::from_str(line)
        {
            let class = object.get("class").and_then(Value::as_str).unwrap_or_default().to_owned();
            examples.push(OutputExample { heading, class, keys: object.keys().cloned().collect() });
        }
    }
    examples
}
