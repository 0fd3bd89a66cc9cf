"""What the service keeps, and where. Begin with data_directory.py (the folder) and database.py (its tables).

settings.py reads what an operator says. artifact_store.py is a bucket or folder that machines share; artifacts.py says what of the data
directory goes there, and when. register_asset.py lists a finished asset; asset_folder.py and training_views.py
read one without torch. bundled.py finds the sample that comes with the service.
"""
