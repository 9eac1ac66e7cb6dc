//! Common parts of the pages. Each page is one file that loads nothing else.

use data_encoding::BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::picture::Picture;

// On a phone a row of a table is a paragraph: a table that is wider would have to be scrolled, and
// the reason of a failure is in its last column. `data-name` is then the head of a column.
const STYLE: &str = "\
body{font:15px/1.45 system-ui,sans-serif;max-width:1160px;margin:2em auto;padding:0 1em;color:#111}
h1{font-size:1.6em}h2{margin-top:2em;font-size:1.2em}
table{border-collapse:collapse;font-size:13px;display:block;overflow-x:auto}td,th{padding:2px 8px;border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
td.text{min-width:13em}td:first-child,td a{white-space:nowrap}pre{margin:0;white-space:pre-wrap;overflow-wrap:anywhere}
.passed,.better{color:#00703c}.failed,.worse{color:#b00020;font-weight:600}.technical{color:#b05a00}
.off_model,.not_judged,.unknown,.changed{color:#777}
figure{margin:0 0 1.5em 0}figure img{width:min(100%,760px);height:auto}svg{box-sizing:border-box;border:1px solid #eee;margin-right:6px;max-width:100%;height:auto}
.beside{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,320px),1fr));gap:0 16px}h3{font-size:1em;margin:1.4em 0 0}
.verdict{font-size:1.25em;padding:.6em .8em;border-left:6px solid;background:#f6f6f6;overflow-wrap:anywhere}
@media (max-width:700px){tr{display:flex;flex-wrap:wrap;gap:0 10px;padding:5px 0;border-bottom:1px solid #ddd}tr:has(th){display:none}
td{border:0;padding:0;overflow-wrap:anywhere}td:first-child{font-weight:600}td:first-child,td a{white-space:normal}td.text,td.score{flex:0 0 100%}td:empty{display:none}
td[data-name]::before{content:attr(data-name) \" \";color:#666;font-weight:400}}";

/// How to read the names in a table of scores.
pub(crate) const SCORE_NAMES: &str = "A name is PROJECT.SCORE@VERSION: the project that defines the score, \
                                      and its version or commit.";

/// A page with a title.
pub(crate) fn document(title: &str, body: &Markup) -> String {
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                (body)
            }
        }
    };
    markup.into_string() + "\n"
}

/// A sentence with its first letter in upper case.
pub(crate) fn capitalized(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// A share of 1 in percent.
pub(crate) fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// A picture with a text below.
pub(crate) fn image(picture: &Picture, text: &str) -> Markup {
    let source = format!("data:image/jpeg;base64,{}", BASE64.encode(&picture.jpeg));
    html! { div { img src=(source) alt=(text); br; small { (text) } } }
}
