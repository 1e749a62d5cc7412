//! What criterion wrote, as the lines that other benches print: median time of one call, with the confidence interval where
//! others have the spread of their runs. Refuses to know what was timed.

use std::fs::{read_dir, read_to_string};
use std::path::Path;

use serde_json::{Value, json};

/// A line for each benchmark below `directory`, in order of their names.
pub(crate) fn lines(bench: &str, directory: &Path) -> Result<Vec<Value>, String> {
    let mut found = Vec::new();
    collect(bench, directory, &mut found)?;
    if found.is_empty() {
        return Err(format!(
            "{}: criterion wrote nothing; run `cargo bench --bench {bench}` first",
            directory.display()
        ));
    }
    found.sort_by(|a, b| a["name"].as_str().cmp(&b["name"].as_str()));
    Ok(found)
}

fn collect(bench: &str, directory: &Path, found: &mut Vec<Value>) -> Result<(), String> {
    let of =
        |error| format!("{}: {error}; name the directory that CRITERION_HOME named", directory.display());
    for entry in read_dir(directory).map_err(of)? {
        let path = entry.map_err(of)?.path();
        if path.join("estimates.json").is_file() && path.ends_with("new") {
            found.push(line(bench, &path)?);
        } else if path.is_dir() {
            collect(bench, &path, found)?;
        }
    }
    Ok(())
}

fn line(bench: &str, directory: &Path) -> Result<Value, String> {
    let read = |name: &str| -> Result<Value, String> {
        let path = directory.join(name);
        let of = |error: String| format!("{}: {error}; time it again", path.display());
        let text = read_to_string(&path).map_err(|error| of(error.to_string()))?;
        serde_json::from_str(&text).map_err(|error| of(error.to_string()))
    };
    let (benchmark, estimates, sample) =
        (read("benchmark.json")?, read("estimates.json")?, read("sample.json")?);
    let median = &estimates["median"];
    let us = |value: &Value| value.as_f64().map(|ns| ns / 1e3);
    let interval = &median["confidence_interval"];
    Ok(json!({
        "class": "measurement", "bench": bench, "name": benchmark["title"], "unit": "us",
        "runs": sample["times"].as_array().map(Vec::len),
        "hub": {
            "median": us(&median["point_estimate"]),
            "least": us(&interval["lower_bound"]),
            "most": us(&interval["upper_bound"]),
        },
        "floor": null, "ratio": null, "target": null, "met": null,
    }))
}
