"""Camera poses from the views themselves: the poses that explain the views best, given the light of other views."""
