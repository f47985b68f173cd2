//! The report as JUnit XML.

use super::check::{Outcome, Verdict};

/// The verdicts as a test suite in JUnit XML.
#[must_use]
pub fn junit(verdicts: &[Verdict]) -> String {
    let count = |which: fn(&Outcome) -> bool| verdicts.iter().filter(|v| which(&v.outcome)).count();
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuite name=\"coflash more conform\" tests=\"{}\" failures=\"{}\" skipped=\"{}\">\n",
        verdicts.len(),
        count(|outcome| matches!(outcome, Outcome::Failed(_))),
        count(|outcome| matches!(outcome, Outcome::Skipped(_))),
    );
    for Verdict { check, outcome } in verdicts {
        let name = escaped(&format!("{} {}", check.id, check.title));
        text += &format!("  <testcase classname=\"{}\" name=\"{name}\"", check.group());
        text += &match outcome {
            Outcome::Passed => "/>\n".to_string(),
            Outcome::Failed(what) => {
                let clause = escaped(check.clause);
                format!("><failure message=\"{}\">{clause}</failure></testcase>\n", escaped(what))
            }
            Outcome::Skipped(why) => format!("><skipped message=\"{}\"/></testcase>\n", escaped(why)),
        };
    }
    text + "</testsuite>\n"
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_told_with_its_clause_and_without_markup() {
        let check = super::super::checks()[0];
        let text = junit(&[Verdict { check, outcome: Outcome::Failed("a<b & \"c\"".to_string()) }]);
        assert!(text.contains("tests=\"1\" failures=\"1\" skipped=\"0\""), "{text}");
        assert!(text.contains("message=\"a&lt;b &amp; &quot;c&quot;\">CiA 301"), "{text}");
    }
}
