"""Makes pages and pictures: self-contained HTML files, figures for papers, recordings for a viewer."""
