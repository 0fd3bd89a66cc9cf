"""What photographs say of a mesh's vertices: which ones they show, what is metal, what is certain, fine albedo, hollows."""
