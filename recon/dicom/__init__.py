"""Results as a DICOM study, for hospitals' archives: volume, segmentation, surfaces and report, written and read back."""
