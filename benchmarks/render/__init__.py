"""Pictures of an asset: time, and error against an independent path tracer; where the limits of light transport are."""
