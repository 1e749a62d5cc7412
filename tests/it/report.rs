//! The tables of benches/README.md: lines of a bench become these rows, and what criterion wrote becomes such lines.

#[path = "../../benches/report/criterion.rs"]
mod criterion;
#[path = "../../benches/report/tables.rs"]
pub(crate) mod tables;

use std::fs;

use serde_json::json;

fn written(lines: &[serde_json::Value]) -> String {
    let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
    let page = format!("Before.\n{}\n\nOld.\n\n{}\nAfter.\n", tables::BEGIN, tables::END);
    let page = tables::page(&page, &[("planted", &lines)]).expect("a page with markers");
    let (before, rest) = page.split_once(tables::BEGIN).expect("a marker");
    let (written, after) = rest.split_once(tables::END).expect("a marker");
    assert_eq!((before, after), ("Before.\n", "\nAfter.\n"));
    written.trim().to_owned()
}

#[test]
fn figures_become_rows() {
    let spread = |median, least, most| json!({ "median": median, "least": least, "most": most });
    let page = written(&[
        json!({ "class": "measurement", "name": "time", "unit": "us", "runs": 5, "hub": spread(79.94, 64.3, 1083.8),
                "floor": spread(34.0, 34.0, 34.0), "ratio": spread(2.181, 1.78, 2.54), "target": "ratio <= 2", "met": false,
                "seen": "any other key" }),
        json!({ "class": "measurement", "name": "a|b", "unit": "1", "runs": 1, "hub": spread(75200.0, 75200.0, 75200.0),
                "floor": null, "ratio": null, "target": "<= 0.5", "met": true }),
        json!({ "class": "else", "name": "for programs" }),
        json!({ "class": "run", "commit": "0123", "date": "2026-01-02", "machine": "Machine", "cores": 2, "kernel": "6.1",
                "load": "0.10 0.20 0.30", "others": 0.05, "seconds": 412, "command": "benches/run planted",
                "pictures": ["planted.svg"] }),
    ]);
    let expected = "### `planted`\n\n\
        Commit 0123, 2026-01-02: Machine, 2 cores, Linux 6.1, load 0.10 0.20 0.30 before, 0.0500 cores busy with other work; \
        412 s. `benches/run planted`\n\n\
        |  | runs | hub | floor | ratio | target |\n|---|---|---|---|---|---|\n\
        | time, us | 5 | 79.9 [64.3 .. 1084] | 34 | 2.18 [1.78 .. 2.54] | ratio <= 2: **missed** |\n\
        | a\\|b | 1 | 75,200 |  |  | <= 0.5: met |\n\n\
        ![planted.svg](pictures/planted.svg)";
    assert_eq!(page, expected);
}

#[test]
fn cells_become_a_matrix() {
    let cell = |table: &str, row: &str, column: &str, unit: &str, value: Option<f64>| {
        let value = value.map(|value| json!({ "median": value, "least": value, "most": value }));
        json!({ "class": "cell", "table": table, "row": row, "column": column, "unit": unit, "value": value })
    };
    let page = written(&[
        cell("one unit", "ours", "10", "%", Some(0.1234)),
        cell("mixed", "pipe", "load", "%", Some(5.0)),
        cell("mixed", "pipe", "age", "us", Some(-12.34)),
        cell("one unit", "theirs", "100", "%", Some(1e6)),
        cell("mixed", "ours", "load", "%", None),
    ]);
    let expected = "### `planted`\n\n\
        **one unit, %**\n\n|  | 10 | 100 |\n|---|---|---|\n| ours | 0.123 |  |\n| theirs |  | 1,000,000 |\n\n\
        **mixed**\n\n|  | load, % | age, us |\n|---|---|---|\n| pipe | 5 | -12.3 |\n| ours |  |  |";
    assert_eq!(page, expected);
}

#[test]
fn a_page_without_markers_and_a_broken_line_are_refused() {
    assert!(tables::page("text", &[]).is_err_and(|error| error.contains(tables::BEGIN)));
    let page = format!("{}{}", tables::BEGIN, tables::END);
    let error = tables::page(&page, &[("planted", "{}\nno line\n")]).expect_err("no line");
    assert!(error.contains("benches/last/planted.jsonl:2"), "{error}");
}

#[test]
fn estimates_become_lines() {
    let directory = std::env::temp_dir().join(format!("scanhub-test-report-{}", std::process::id()));
    let new = directory.join("a group").join("b").join("new");
    fs::create_dir_all(&new).expect("a directory of our own");
    let interval = json!({ "lower_bound": 1190.0, "upper_bound": 1300.0 });
    for (name, content) in [
        ("benchmark.json", json!({ "title": "a group/b" })),
        (
            "estimates.json",
            json!({ "median": { "point_estimate": 1200.0, "confidence_interval": interval } }),
        ),
        ("sample.json", json!({ "times": [1.0, 2.0, 3.0] })),
    ] {
        fs::write(new.join(name), content.to_string()).expect("a file of our own");
    }
    let lines = criterion::lines("protocol", &directory);
    let none = criterion::lines("protocol", &new);
    fs::remove_dir_all(&directory).expect("all of it is ours");
    let lines = lines.expect("a benchmark");
    assert_eq!(lines.len(), 1);
    assert_eq!((&lines[0]["name"], &lines[0]["runs"]), (&json!("a group/b"), &json!(3)));
    assert_eq!(lines[0]["hub"], json!({ "median": 1.2, "least": 1.19, "most": 1.3 }));
    assert!(none.is_err_and(|error| error.contains("cargo bench --bench protocol")));
}
