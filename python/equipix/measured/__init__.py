"""From frames to means with all that is known of them: noise, saturation, bad pixels."""
