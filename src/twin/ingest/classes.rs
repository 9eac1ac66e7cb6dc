//! The classes of Gaussians in the formats that have a column for them.

use wildcity_scene::SemanticClass;

/// The name of the property, or of the tensor. `class` and `label` would also be the names of
/// columns that other programs write with other numbers.
pub(super) const NAME: &str = "semantic_class";

/// The class of a value.
///
/// # Errors
/// No Gaussian may have it. Says which values are possible.
pub(super) fn class(value: f64) -> Result<SemanticClass, String> {
    // 0 to 255 without a fraction: others do not survive the cast.
    let byte = value as u8;
    let class = if f64::from(byte) == value { SemanticClass::for_gaussian(byte) } else { None };
    class.ok_or_else(|| {
        let last = SemanticClass::ALL.len() - 1;
        format!("{NAME} is {value}; the classes of Gaussians are 1 to {last}, and 1 is unlabelled")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_numbers_of_the_table_are_classes() {
        assert_eq!(class(1.0), Ok(SemanticClass::Unlabelled));
        assert_eq!(class(24.0), Ok(SemanticClass::Vehicle));
        for value in [0.0, -1.0, 2.5, 25.0, 255.0, 258.0, f64::NAN, f64::INFINITY] {
            let refused = class(value).unwrap_err();
            assert!(refused.starts_with(&format!("semantic_class is {value};")), "{refused}");
        }
    }
}
