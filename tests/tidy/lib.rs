//! Empty library. The package exists so that these tests compile without the rest of the workspace.
